"""Devices that speak the wire: a client gets the bytes that a controller would send.

engine.py     what they share
motion.py     motors with finite acceleration, on any clock
faults.py     what goes wrong, and when: seeded
gcs.py        a PI controller, GCS 2.0
picomotor.py  a Picomotor 8742
serve.py      an engine behind TCP or a pseudo terminal
usb_bus.py    an engine behind a pyusb backend
"""
