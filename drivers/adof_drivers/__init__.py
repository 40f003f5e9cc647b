"""Hardware. Knows nothing of adof_cl; the closed loop takes these devices by shape.

image_sequence.py    a camera that replays PNG and TIFF files
"""
