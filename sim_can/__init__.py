"""Emulated bench: two harmonic-drive joints coupled by a torque sensor, and their CANopen nodes on a bus.

Plant files and commands, or a measured run, in; frames on a bus (`jtq sim`, `python -m jtqd.sim_can`) or run tables out.
Imports estimator, drivers, models and, to play a run (`play`), `jtqd.sysid.runs`; the plant itself (`plant`,
`emulated_run`) only estimator.

| module | what it has |
|---|---|
| `drives` | drives' loops, instruments, and the frame of a plant: what all benches share |
| `plant_file` | plant files as values: `load_plant`, `PlantParameters`; how days differ |
| `plant`, `effect_plant` | their equations, without (compiled) and with effects of joint files |
| `towing` | benches with laws of their own |
| `source`, `plant_source`, `play` | what the nodes measure: `Source`, from any plant (`load_any_plant`) or a measured run |
| `emulated_run` | runs without a bus: `emulate_run`, `JointCommand` |
| `canopen_node`, `devices`, `transmit` | nodes on the bus: CANopen services, drive and sensor, their TPDOs |
| `bench`, `command` | the nodes with the bus around them, `jtq sim` |
| `bench_kernel` | a Linux kernel as an ordinary process: SocketCAN on any machine |

Half a second of joint 1 at 1 rad/s against 2 A of joint 2:

>>> from jtqd.models.files import shipped
>>> from jtqd.sim_can.emulated_run import JointCommand, emulate_run
>>> from jtqd.sim_can.plant_file import load_plant
>>> plant = load_plant(shipped("plant.yaml"))
>>> commands = JointCommand.velocity(lambda t: min(t / 0.2, 1.0)), JointCommand.current(lambda t: 2.0)
>>> run = emulate_run(plant, commands, duration_s=0.5, seed=1)
>>> print(f"{len(run.time_s)} samples, {run.joints[1].torque_nm[-1]:.1f} Nm at the sensor")
500 samples, 16.1 Nm at the sensor
"""
