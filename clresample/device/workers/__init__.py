"""Workers that may fail: one loop gives them tasks, whether they are processes or a cluster's.

Nothing here imports more than the package's devices.
"""
