"""Hardware. Knows nothing of adof_cl; the closed loop takes these devices by shape."""
