"""What executors are made of: their memory on the device, tables, and sums over terms.

Imports device alone.
"""
