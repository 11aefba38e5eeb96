"""Drivers of real devices: a serial pressure controller, motion capture over the network.

`line_protocol` is what the controller and the computer say to each other, `serial_controller` the
driver of it; `motion_capture` receives frames (`natnet` for OptiTrack, JSON for any other system);
`bench_map` states which marker is which key point, and in which frame; `serial_rig` puts the two
together to a rig; `emulator` stands in for the devices on this computer.
"""
