"""One OpenCL device: finding and choosing it, its memory, building and launching kernels.

The lowest layer: imports no other package of clresample. The kernels are OpenCL C files in the
folder kernels/ of the checkout (clresample/kernels/ once installed).
"""
