"""Properties that hold for any input: few and the same examples in the suite, `make fuzz` for more.

CLRESAMPLE_EXAMPLES: how many examples of each; then they differ from run to run.
"""

import os

try:
    import hypothesis
except ImportError:  # of the extra `dev`: without it these tests are left out
    collect_ignore_glob = ["test_*.py"]
else:
    N_EXAMPLES = int(os.environ.get("CLRESAMPLE_EXAMPLES") or 0)
    hypothesis.settings.register_profile(
        "clresample",
        max_examples=N_EXAMPLES or 25,
        derandomize=not N_EXAMPLES,
        database=None,
        deadline=None,  # a device's first launch takes its time
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    hypothesis.settings.load_profile("clresample")
