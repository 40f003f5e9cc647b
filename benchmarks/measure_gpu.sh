#!/usr/bin/env bash
# Everything we want to know of a device, in one call, on a machine that need not reach any package index.
#
#   benchmarks/measure_gpu.sh pack WHEELS       where there is a network: all wheels into WHEELS
#   benchmarks/measure_gpu.sh run WHEELS OUT    on the device's machine: tests, tables and plots into OUT
#
# `run` takes the vendor's OpenCL from wherever its driver lies, by an .icd file of its own where there is none.
# ADOF_DEVICE chooses the device, a GPU by default. What fails is said at the end, and does not stop the rest.
# `pack` wants the Python version of the device's machine (PYTHON=python3.12), and for pyvkfft, which has no binary
# wheel, the OpenCL headers.
set -euo pipefail
cd "$(dirname "$0")/.."

pack() {
    local wheels=$1 python=${PYTHON:-python3}
    mkdir -p "$wheels"
    "$python" -m pip wheel -q -w "$wheels" '.[test]' psutil
    "$python" -m pip wheel -q -w "$wheels" mkl_fft pyfftw || echo "no MKL or FFTW: measure without these peers"
    VKFFT_BACKEND=opencl "$python" -m pip wheel -q --no-deps -w "$wheels" pyvkfft ||
        echo "no pyvkfft: install the OpenCL headers and library, or measure without this peer"
}

run() {
    local wheels=$1 out=$2 failed=() venv library
    mkdir -p "$out"
    venv=$(mktemp -d)/venv
    python3 -m venv "$venv"
    "$venv/bin/pip" install -q --no-index --find-links "$wheels" 'adof-cl[test]'
    "$venv/bin/pip" install -q --no-index --find-links "$wheels" mkl_fft pyfftw psutil || true
    "$venv/bin/pip" install -q --no-index --find-links "$wheels" --no-deps pyvkfft || true

    # The loader that pyopencl brings reads only its own folder; pyvkfft wants one by its usual name.
    if [ -z "${OCL_ICD_VENDORS:-}" ]; then
        export OCL_ICD_VENDORS="$venv/vendors"
        mkdir -p "$OCL_ICD_VENDORS"
        cp /etc/OpenCL/vendors/*.icd "$OCL_ICD_VENDORS" 2>/dev/null || true
        library=$(find / -xdev -name 'libnvidia-opencl.so.1' -print -quit 2>/dev/null || true)
        [ -z "$library" ] || echo "$library" >"$OCL_ICD_VENDORS/nvidia.icd"
    fi
    library=$(find "$venv" -name 'libOpenCL*.so*' -print -quit)
    mkdir -p "$venv/loader" && ln -sf "$library" "$venv/loader/libOpenCL.so.1"
    export LD_LIBRARY_PATH="$venv/loader:${LD_LIBRARY_PATH:-}" ADOF_DEVICE="${ADOF_DEVICE:-gpu}"
    export ADOF_CACHE_DIR="$venv/kernels"

    step() { # step NAME COMMAND ...: its output into a file of that name
        local name=$1 began=$SECONDS
        shift
        if "$@" >"$out/$name.txt" 2>&1; then
            echo "$name: $((SECONDS - began)) s"
        else
            failed+=("$name")
            echo "$name FAILED after $((SECONDS - began)) s:"
            tail -5 "$out/$name.txt"
        fi
    }
    step devices "$venv/bin/adof" devices
    step selftest "$venv/bin/adof" selftest --small
    for size in 512x400 659x494 1024x1024 2048x2048; do
        step "parts-$size" "$venv/bin/python" benchmarks/chain_parts.py --size "$size"
    done
    for size in 512x400 1024x1024; do
        step "batch-$size" "$venv/bin/python" benchmarks/batch.py --size "$size"
    done
    step bench "$venv/bin/adof" bench --json "$out/bench.json" --plot "$out/bench.png"
    step scaling "$venv/bin/python" benchmarks/scaling.py --json "$out/scaling.json" --plot "$out/scaling.png"
    step streaming "$venv/bin/python" benchmarks/streaming.py
    step tests "$venv/bin/pytest" -q -m "kernel and not slow" -p no:cacheprovider \
        --ignore=tests/test_loop.py --ignore=tests/test_survey.py --ignore=tests/test_cli_run.py \
        --ignore-glob='tests/test_*bench.py'
    cat "$out"/devices.txt "$out"/parts-*.txt "$out"/batch-*.txt "$out"/bench.txt "$out"/scaling.txt
    [ ${#failed[@]} -eq 0 ] || {
        echo "failed: ${failed[*]}"
        return 1
    }
}

case "${1:-}" in
pack | run) [ $# -ge 2 ] && "$@" ;;
*) sed -n '2,10s/^# \{0,1\}//p' "$0" ;;
esac
