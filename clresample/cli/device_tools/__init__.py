"""Commands that measure devices: `clresample devices --bench` and `clresample tune`."""
