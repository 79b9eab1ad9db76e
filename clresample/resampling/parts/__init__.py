"""What executors are made of: their memory on the device, and sums over an operator's terms.

Imports device alone.
"""
