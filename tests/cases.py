"""One case per operation: known inputs, the device's answer, the reference's answer and the bound.

Tests and `adof selftest` share the same known answers through `adof_cl.selftest`; this file adds the sizes
and seeds only tests need.
"""
