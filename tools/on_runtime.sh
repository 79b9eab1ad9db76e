#!/usr/bin/env bash
# Runs a command on one OpenCL runtime:  tools/on_runtime.sh RUNTIME COMMAND ...
#
# RUNTIME is one of
#   pocl         PoCL, as pip install 'pyopencl[pocl]' brings it
#   pocl-debian  Debian's PoCL
#   intel        Intel's runtime for CPUs, from pip
#   pair         Intel's beside PoCL's wheel: two unlike devices in one process
#   rusticl      Mesa's OpenCL on llvmpipe: a CPU that behaves as a GPU without double precision
#   oclgrind     a simulator that reports races and accesses out of bounds on standard error
#   gpu-compilers  none: compilers for GPUs of NVIDIA, AMD and Intel, in $GPU_COMPILERS and, from
#                pip, $GPU_COMPILERS_PYTHON, and the runtime that is there
#
# What it needs is fetched into $RUNTIMES/RUNTIME (default .runtimes) once: by pip, or by apt-get
# download and dpkg -x, which need no root. Nothing is installed on the machine. Where it cannot be
# fetched, one line says so and the status is 77.
set -euo pipefail

runtime=$1
shift
skip() {
    echo "skipped: no runtime $runtime here: $*" >&2
    exit 77
}

mkdir -p "${RUNTIMES:-.runtimes}" 2>/dev/null || skip "${RUNTIMES:-.runtimes} cannot be written"
home=$(cd "${RUNTIMES:-.runtimes}" && pwd)/$runtime
here=$(cd "$(dirname "$0")" && pwd)
root=$home/root
arch=$(uname -m)-linux-gnu

# unpack PACKAGES [NAMES]: Debian packages and what they need beside what is installed here. Packages
# whose names match the regular expression NAMES are left out.
unpack() {
    [ -e "$home/made" ] && return
    command -v apt-get dpkg >/dev/null || skip "apt-get and dpkg are needed"
    mkdir -p "$home/debs" "$root"
    local names
    # shellcheck disable=SC2086  # one word a package
    names=$(apt-get install --simulate --no-install-recommends $1 2>/dev/null |
        awk '/^Inst/ {print $2}' | grep -vxE "lib32.*|libc6-i386|libobjc.*${2:+|$2}" || true)
    [ -n "$names" ] || skip "apt-get does not know $1, or it is installed"
    # shellcheck disable=SC2086  # one word a package
    (cd "$home/debs" && timeout 300 apt-get download $names) >"$home/log" 2>&1 ||
        skip "$(tail -n 1 "$home/log")"
    for deb in "$home"/debs/*.deb; do dpkg -x "$deb" "$root"; done
    rm -r "$home/debs"
    touch "$home/made"
}

libraries() {
    export LD_LIBRARY_PATH="$root/usr/lib/$arch:$root/usr/lib/llvm-15/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
}

# pyopencl keeps what some drivers built by the source alone, whatever else they were told.
export PYOPENCL_NO_CACHE=1
case $runtime in
pocl) ;;
pocl-debian)
    unpack pocl-opencl-icd
    libraries
    export PATH="$root/usr/bin:$PATH" OCL_ICD_VENDORS=$root/usr/lib/$arch/libpocl.so.2
    export POCL_CACHE_DIR="${POCL_CACHE_DIR:-$home/cache}-debian"
    mkdir -p "$POCL_CACHE_DIR"
    ;;
rusticl)
    unpack mesa-opencl-icd 'libegl-mesa0|libglx-mesa0|libgl1-mesa-.*'
    libraries
    [ -e "$home/unpacked.so" ] || cc -O1 -shared -fPIC "$here/unpacked.c" -o "$home/unpacked.so" -ldl ||
        skip "a C compiler is needed"
    export UNPACKED=$root LD_PRELOAD=$home/unpacked.so RUSTICL_ENABLE=llvmpipe
    export OCL_ICD_VENDORS=$root/usr/lib/$arch/libRusticlOpenCL.so.1
    ;;
intel | pair)
    home=${home%/*}/intel
    python=$(command -v "${PYTHON:-python3}")
    if [ ! -e "$home/made" ]; then
        mkdir -p "$home"
        { "$python" -m venv --without-pip "$home/venv" &&
            timeout 300 "$python" -m pip --python "$home/venv/bin/python" install --quiet \
                intel-opencl-rt intel-cmplr-lib-rt; } >"$home/log" 2>&1 ||
            skip "$(tail -n 1 "$home/log")"
        touch "$home/made"
    fi
    export OCL_ICD_VENDORS=$home/venv/lib/libintelocl.so
    if [ "$runtime" = pair ]; then # of a folder the loader reads the wheel's driver too
        [ -e "$OCL_ICD_VENDORS" ] || skip "$OCL_ICD_VENDORS is missing"
        mkdir -p "$home/vendors"
        echo "$OCL_ICD_VENDORS" >"$home/vendors/intel.icd"
        OCL_ICD_VENDORS=$home/vendors
    fi
    ;;
oclgrind)
    unpack oclgrind
    libraries
    export OCL_ICD_VENDORS=$root/usr/lib/oclgrind/liboclgrind-rt-icd.so
    export OCLGRIND_DATA_RACES=1
    ;;
gpu-compilers)
    packages="clang-19 libclc-19 llvm-19 rocm-device-libs intel-opencl-icd"
    # shellcheck disable=SC2086  # one word a package
    dpkg -s $packages >/dev/null 2>&1 || unpack "$packages" 'ocl-icd-.*'
    export GPU_COMPILERS=$root GPU_COMPILERS_PYTHON=$home/python
    # a target without its compiler is left out, and named
    [ -e "$GPU_COMPILERS_PYTHON" ] || command -v ptxas >/dev/null ||
        timeout 300 "${PYTHON:-python3}" -m pip install --quiet --target "$GPU_COMPILERS_PYTHON" \
            nvidia-cuda-nvcc >>"$home/log" 2>&1 || rm -rf "$GPU_COMPILERS_PYTHON"
    ;;
*)
    echo "RUNTIME is $runtime; there are pocl, pocl-debian, intel, pair, rusticl, oclgrind and" \
        "gpu-compilers" >&2
    exit 2
    ;;
esac
[ -z "${OCL_ICD_VENDORS:-}" ] || [ -e "$OCL_ICD_VENDORS" ] || skip "$OCL_ICD_VENDORS is missing"
exec "$@"
