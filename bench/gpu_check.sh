#!/usr/bin/env bash
# For the first time on a machine with a GPU: everything that is measured of a device, in one
# Markdown report, in less than ten minutes.
#
#     bench/gpu_check.sh [REPORT.md]
#
# PYTHON is the interpreter that has clresample (default .venv/bin/python, as make makes it);
# CLRESAMPLE_DEVICE and CLRESAMPLE_ICD choose the device, as always. If a GPU is there and cannot be
# used, the report says why and nothing is measured. A step that fails, or takes longer than its
# limit, is named in the report, and the others go on; then the status is 1.
set -uo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
report=${1:-gpu_check.md}
part=$(mktemp)
trap 'rm -f "$part"' EXIT
failed=0

# step TITLE SECONDS COMMAND ...: the command's output as a part of the report
step() {
    local title=$1 limit=$2 began=$SECONDS status=0
    shift 2
    echo "gpu_check: $title" >&2
    timeout "$limit" "$@" >"$part" 2>&1 || status=$?
    {
        printf '\n## %s\n\n' "$title"
        [ "$status" = 0 ] || printf '**Failed, status %s (124: over %s s).**\n\n' "$status" "$limit"
        printf '    $ %s\n\n' "$(printf '%s' "$*" | head -n 1)"
        tr '\r' '\n' <"$part" | grep -v '^ *$' | tail -n 60 | sed 's/^/    /'
        printf '\n%s s.\n' "$((SECONDS - began))"
    } >>"$report"
    [ "$status" = 0 ] || failed=1
}

name=$("$python" -c '
import warnings
from clresample import DeviceError, get_device
from clresample.device.device_cache import DeviceWarning
from clresample.device.discovery import HIDDEN_GPU
for text in (HIDDEN_GPU, ".* fails its self-test"):  # a CPU instead of a GPU
    warnings.filterwarnings("error", text, DeviceWarning)
try:
    print(get_device())
except (DeviceError, DeviceWarning) as error:
    raise SystemExit(str(error))' 2>"$part") || name=
{
    printf '# %s\n\n' "${name:-No device}"
    printf '%s, %s, commit %s.\n' "$(date -u +%Y-%m-%dT%H:%MZ)" "$(uname -sm)" \
        "$(git rev-parse --short HEAD 2>/dev/null || echo unknown)"
    if [ -z "$name" ]; then
        printf '\n**No GPU could be used, nothing was measured.**\n\n'
        sed 's/^/    /' "$part"
    fi
} >"$report" || exit 1
if [ -z "$name" ]; then
    cat "$part" >&2
    echo "gpu_check: $report" >&2
    exit 1
fi

export PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1
step "Devices" 40 "$python" -m clresample.cli devices --bench
step "Self-test" 30 "$python" -c '
import numpy as np
from clresample import get_device
from clresample.device.selftest import ALLOWED, reference, render
found, truth = render(get_device()), reference()
error = np.linalg.norm(found - truth) / np.linalg.norm(truth)
print(f"a small render in float32 against NumPy in float64: {error:.1e}, {ALLOWED:g} allowed")
raise SystemExit(not error <= ALLOWED)'
step "Fits" 70 "$python" -m bench.throughput --quick
step "Kernels of a fit" 25 env CLRESAMPLE_PROFILE=1 "$python" -c '
from clresample import get_device
from clresample.cli.device_tools.workload import blends, fit
device = get_device()
fit(blends(8, device), device)'
step "Fits by eight processes" 60 "$python" -m bench.throughput --scenes 64 --processes 8 --blends
step "Matrix products" 30 "$python" -m bench.contract
# The suite: the tests of all kernels, as `make test-kernels-on` has them.
read -r -a tests <<<"$(make -s kernel-tests)"
step "Kernel tests" 170 "$python" -m pytest -q -n auto --maxprocesses 12 --dist loadfile -p no:cacheprovider "${tests[@]}"
step "Renders" 40 "$python" -m bench.render --quick
step "Tuning" 90 "$python" -m clresample.cli tune
step "Devices, tuned" 30 "$python" -m clresample.cli devices --bench
echo "gpu_check: $report" >&2
exit "$failed"
