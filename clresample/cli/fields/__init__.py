"""Progress of `clresample field`, and `clresample report`."""
