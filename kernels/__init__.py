"""OpenCL C sources, one file per operation; this file makes them installable as data."""
