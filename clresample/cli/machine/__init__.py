"""What the devices of this machine can do: `clresample devices --bench` and `clresample tune`."""
