"""Everything between a wire and numbers: CAN frames, frame sockets, CANopen services, the devices on the bus, their boot.

Frames come in and go out as 16 bytes (`struct can_frame`); numbers are those of object dictionaries and PDOs.
It imports nothing else of jtqd. canopen and python-can are imported by `boot` (a process of its own) and `can_unix` alone,
and canopen's EDS parser by `object_dictionary.read_eds` when it is called. Import the modules themselves:

    frame, filters              the 16 bytes, kernel filters
    frame_socket, bus_socket    SocketCAN or a unix socket, alike to use, all frames by one system call; opening them
    hub, relay, wire            hub of a unix bus, `python -m jtqd.drivers.hub`; its members; a wire's times
    object_dictionary, pdo      objects typed by an EDS, PDO mappings as `struct`, rules for changing them
    sdo, sdo_client, sdo_server the protocol and a queue; blocking clients; the server
    nmt, emcy, cia402           NMT commands and states, EMCY codes, states of a drive
    devices, survey, bus_load   what drives and sensor must map and scale; what a device tells; load of a configuration
    boot_procedure, boot        one node by SDO (CiA 302-2); the whole bus, `python -m jtqd.drivers.boot`
    can_unix, eds               unix bus for python-can; data sheets

>>> from jtqd.drivers.drive import drive_tpdo2
>>> pdo = drive_tpdo2(node=1)
>>> f"{pdo.cob_id:X}h", pdo.names
('281h', ('motor_velocity', 'current', 'statusword'))
>>> pdo.layout.unpack(bytes.fromhex("10 27 00 00 F4 01 37 02"))
(10000, 500, 567)
"""
