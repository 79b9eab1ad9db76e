"""One OpenCL device: finding and choosing it, its memory, building and launching kernels.

The ground floor: imports nothing of clresample's. The kernels themselves are OpenCL C files in the
folder kernels/ of the checkout (clresample/kernels/ once installed).
"""
