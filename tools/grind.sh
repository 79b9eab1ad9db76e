#!/usr/bin/env bash
# Every kernel under Oclgrind, as built for CPUs and for GPUs: tools/grind.sh PYTHON
#
# Races, and reads and writes beyond a buffer, are reported by Oclgrind on standard error; any line
# there fails. First a race and an overrun are planted, which must be reported. Where Oclgrind cannot
# be fetched, one line says so and the status is 0.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1
log=$(mktemp)
trap 'rm -f "$log"' EXIT

grind() {
    local status=0
    tools/on_runtime.sh oclgrind "$python" tools/grind.py "$@" 2>"$log" || status=$?
    # its compiler counts the loops that it did not vectorise there: no report
    sed -i -E '/^[0-9]+ warnings? generated\.$/d' "$log"
    if [ "$status" = 77 ]; then
        cat "$log" >&2
        exit 0
    fi
    return "$status"
}

declare -A reports=([race]='data race at global memory' [overrun]='^Invalid write of size')
for fault in race overrun; do
    grind --plant "$fault" || true
    if ! grep -q "${reports[$fault]}" "$log"; then
        echo "grind: a planted $fault was not reported" >&2
        exit 1
    fi
done
for kind in gpu cpu; do
    status=0
    grind --as "$kind" || status=$?
    if [ -s "$log" ] || [ "$status" != 0 ]; then
        head -n 60 "$log" >&2
        echo "grind: $(grep -c . "$log" || true) lines of reports, as on a ${kind^^}" >&2
        exit 1
    fi
done
echo "grind: no race, no bad access; both planted faults were reported"
