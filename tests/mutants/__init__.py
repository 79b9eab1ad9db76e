"""Mutation testing of the package and its kernels: see __main__.py."""
