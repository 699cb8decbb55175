"""Everything between a wire and numbers: CAN frames, frame sockets, CANopen services, the devices on the bus, their boot.

Frames come in and go out as 16 bytes (`struct can_frame`); numbers are those of object dictionaries and PDOs.
It imports nothing else of jtqd. python-can is imported by `can_unix` alone, and canopen's EDS parser by
`object_dictionary.read_eds` when it is called. Import the modules themselves:

    frame                       the 16 bytes
    frame_socket, bus_socket    SocketCAN or a unix socket, all frames by one system call; opening them, filters
    hub                         hub of a unix bus with a modelled wire, `python -m jtqd.drivers.hub`
    object_dictionary, pdo      objects typed by an EDS and their SDO server; PDO mappings as `struct`
    sdo, nmt, emcy              SDO client, NMT commands and states, EMCY codes (CiA 301)
    drive, sensor               objects, TPDOs and scaling of a drive (CiA 402) and of a torque sensor (CiA 404)
    own_objects, eds            jtqd as a node; data sheets that ship
    boot, boot_node             boot of the bus, `python -m jtqd.drivers.boot`; of one node (CiA 302-2)
    survey, bus_load            identity, scaling and TPDOs of a device; load of a configuration
    can_unix                    unix bus for python-can

>>> from jtqd.drivers.drive import drive_tpdo2
>>> pdo = drive_tpdo2(node=1)
>>> f"{pdo.cob_id:X}h", pdo.names
('281h', ('motor_velocity', 'current', 'statusword'))
>>> pdo.layout.unpack(bytes.fromhex("10 27 00 00 F4 01 37 02"))
(10000, 500, 567)
"""
