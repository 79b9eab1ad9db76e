"""Commands and fields that are killed, starved and damaged: `python -m bench.kills`."""
