"""Parts of executors: their memory on the device, tables, and sums over terms.

Imports device alone.
"""
