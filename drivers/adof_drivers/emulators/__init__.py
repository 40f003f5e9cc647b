"""Devices that speak the real wire formats, so that drivers are proven without hardware.

gige.py       a GigE Vision camera on UDP that serves the pictures it is given, with seeded faults
hid.py        SpaceMouse, pedals, relay board and DLPC900, as hidapi hands them out
hid_nodes.py  these on /dev/hidraw* under umockdev, for a program that opens them with the real hidapi
engine.py     what emulated controllers share
motion.py     motors with finite acceleration, on any clock
faults.py     what goes wrong with a controller, and when: seeded
gcs.py        a PI controller, GCS 2.0
picomotor.py  a Picomotor 8742
gcode.py      an open-hardware micromanipulator
serve.py      an engine behind TCP or a pseudo terminal
usb_bus.py    an engine behind a pyusb backend, with or without an FTDI bridge
"""
