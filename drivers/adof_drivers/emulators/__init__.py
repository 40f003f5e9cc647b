"""Devices that speak the wire: a client gets the bytes that a controller would send.

motion.py     motors with finite acceleration, on any clock
faults.py     what goes wrong, and when: seeded
gcs.py        a PI controller, GCS 2.0
serve.py      an engine behind TCP or a pseudo terminal
usb_bus.py    an engine behind a pyusb backend
"""
