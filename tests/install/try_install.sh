#!/usr/bin/env bash
# Install a wheel into a clean environment, far from the checkout, and try it there: the smoke tests,
# and the command on its own example.
#
#   try_install.sh PYTHON newest|oldest WHEEL
#
# oldest: every dependency in the lowest version that the wheel allows (by uv, beside the wheel's
# own environment). The sdist lies beside the wheel. Ends with the first failure's status.
set -euo pipefail
python=$1 versions=$2 wheel=$(realpath "$3")
checkout=$(cd "$(dirname "$0")/../.." && pwd)
uv=$(realpath "${UV:-$checkout/.venv/bin/uv}")

if ! python=$("$python" -c 'import sys; print(sys.executable)' 2> /dev/null); then
    echo "$1 is not on this machine: not tried"
    exit 0
fi
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
resolution=highest
[ "$versions" = oldest ] && resolution=lowest-direct
"$uv" venv --quiet --python "$python" "$scratch/env"
tar xf "${wheel%-py3*}.tar.gz" -C "$scratch" --strip-components 1
cd "$scratch"
rm -r clresample  # the tests of the sdist, but the package that was installed
"$uv" pip install --quiet --python env/bin/python --resolution "$resolution" \
    -r pyproject.toml --extra pocl --extra sim --extra plot --extra detect 'pytest>=8'
"$uv" pip install --quiet --python env/bin/python --no-deps "$wheel"
echo "== $("$scratch/env/bin/python" --version), $versions dependencies"
"$uv" pip list --quiet --python env/bin/python 2> /dev/null |
    grep -iE '^(numpy|scipy|astropy|pyopencl|tqdm|galsim|matplotlib|sep) ' || true
env/bin/pytest -q -m smoke tests/device tests/resampling
env/bin/clresample devices
env/bin/clresample deblend --example example
env/bin/clresample deblend example/scene.toml -o out
ls out
