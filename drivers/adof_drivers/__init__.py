"""Hardware. Knows nothing of adof_cl; the closed loop takes these devices by shape.

image_sequence.py    a camera that replays PNG and TIFF files
link.py              bytes to a device and back
safety.py            enable latch, limits, watch on motion
stage.py             a stage in front of any controller
gcs.py               PI controllers by GCS 2.0
picomotor.py         New Focus Picomotor 8742
rig.py               the rig file, and the check of what it names
stage_sections.py    its sections for stages
emulators/           controllers that speak the wire
"""
