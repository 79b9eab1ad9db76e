"""What `clresample field` tells while it runs, and `clresample report` afterwards."""
