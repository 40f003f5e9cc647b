"""Hardware. Knows nothing of adof_cl; the closed loop takes these devices by shape.

camera.py            what a camera offers, and a watch over its frames
camera_pair.py       two cameras paired by time
image_sequence.py    a camera that replays PNG and TIFF files
video_capture.py     cameras and videos that OpenCV opens
gige.py              GigE Vision cameras
basler.py            Basler cameras
slm.py               what a modulator offers
slm_window.py        a modulator that is a monitor
phase_table.py       measured phase to codes, a vendor's correction to phase
holoeye.py           HOLOEYE panels through their SDK
dlpc900.py           TI's pattern controller
hid_device.py        HID devices through hidapi
spacemouse.py        six axes to jog with
pedal.py             a foot pedal that stops
relay.py             USB relays
link.py              bytes to a device and back
safety.py            enable latch, limits, watch on motion
stage.py             a stage in front of any controller
gcs.py               PI controllers by GCS 2.0
picomotor.py         New Focus Picomotor 8742
rig.py               the rig file, and the check of what it names
stage_sections.py    its sections for stages
emulators/           devices that speak the real wire formats
"""
