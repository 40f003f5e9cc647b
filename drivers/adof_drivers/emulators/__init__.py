"""Devices that speak the real wire formats, so that drivers are proven without hardware.

gige.py    a GigE Vision camera on UDP that serves the pictures it is given, with seeded faults
hid.py     SpaceMouse, pedal, relay board and DLPC900, as hidapi hands them out
"""
