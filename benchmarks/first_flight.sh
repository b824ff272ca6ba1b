#!/usr/bin/env bash
# Take the CUDA backend to a GPU: examine, test, look for errors of memory, time, run. A step that fails, or takes too long,
# does not stop the next one. What each says lies in $OUT/<step>.log, figures beside it; benchmarks/GPU.md says how to go on.
#
#   benchmarks/first_flight.sh                       # every step, with the sigmasplat that is installed
#   benchmarks/first_flight.sh doctor device         # some of them
#   benchmarks/first_flight.sh prepare python3.12    # wheels into .whl/ for a machine without a network, for that Python
#
# OUT=FOLDER        where to write (runs/flight)
# PYTHON=python3    the interpreter that has torch; packages in .whl/, if there are any, are put before its own
set -uo pipefail
cd "$(dirname "$0")/.."
OUT=${OUT:-runs/flight}
PYTHON=${PYTHON:-$(command -v .venv/bin/python || echo python3)}
STEPS="doctor device tests slam memcheck racecheck peer benchmark kernels profile"
export PYTHONUNBUFFERED=1

# Not in the lent machine's image: tyro with its needs, and gsplat, which is timed beside us (Apache-2.0).
NEEDED="tyro docstring_parser typeguard"
PEER="gsplat==1.5.3"

prepare() {
  local python=${1:-python3.12} tag name
  tag=$("$python" -c 'import sys; n = sys.version_info[1]; print("cp311-cp311" if n == 11 else "cp312-abi3")') || exit 1
  make wheel PYTHON="$("$python" -c 'import sys; print(sys.executable)')" || exit 1
  mkdir -p .whl && rm -f .whl/*.whl
  cp "$(ls -t dist/sigmasplat-*-"$tag"-*.whl | head -n 1)" .whl/
  for name in $NEEDED $PEER; do
    "$python" -m pip download --quiet --no-deps --only-binary=:all: -c constraints.txt -d .whl "$name" || exit 1
  done
  ls -l .whl
}

# The wheel brings the compiled module; texts that are newer here, Python's and the kernels', go over it.
put_wheels_first() {
  ls .whl/*.whl >/dev/null 2>&1 || return 0
  local site
  site=$(mktemp -d)
  "$PYTHON" -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --target "$site" .whl/*.whl || exit 1
  (cd src && find sigmasplat -name '*.so' -prune -o -name __pycache__ -prune -o -type f -print0 | tar c --null -T -) | tar x -C "$site"
  export PYTHONPATH=$site PATH=$site/bin:$PATH
}

# step NAME SECONDS COMMAND…: run it within its time, keep what it says, sum it up in a line.
step() {
  local name=$1 limit=$2 started=$SECONDS code
  shift 2
  echo "== $name: $*"
  [ -n "$1" ] || { echo "$name: left out, its program is not here" | tee -a "$OUT/summary.txt"; return; }
  timeout --kill-after=10 "$limit" "$@" >"$OUT/$name.log" 2>&1
  code=$?
  tail -n "${TAIL:-12}" "$OUT/$name.log"
  [ $code = 124 ] && echo "stopped: it took more than $limit s"
  echo "$name: exit $code, $((SECONDS - started)) s" | tee -a "$OUT/summary.txt"
}

pytest() { step "$1" "$2" "$PYTHON" -m pytest -p no:cacheprovider "${@:3}"; }
sigmasplat=("$PYTHON" -c 'import sys; from sigmasplat.cli import main; sys.exit(main())')
sanitizer() { # NAME SECONDS TOOL TESTS; without torch's cache every tensor is memory of its own, whose bounds are watched
  PYTORCH_NO_CUDA_MEMORY_CACHING=1 step "$1" "$2" "$SANITIZER" --tool "$3" --error-exitcode 9 --print-limit 20 \
    "$PYTHON" -m pytest -p no:cacheprovider -q tests/backend/test_cuda*_device.py -k "$4"
}
SANITIZER=$(command -v compute-sanitizer || ls /usr/local/cuda*/bin/compute-sanitizer 2>/dev/null | head -n 1)
NCU=$(command -v ncu || ls /opt/nvidia/nsight-compute/*/ncu /usr/local/cuda*/bin/ncu 2>/dev/null | head -n 1)

run_doctor() {
  nvidia-smi --query-gpu=name,driver_version,memory.total,clocks.sm,clocks.mem --format=csv >"$OUT/machine.txt" 2>&1
  "$PYTHON" -m pip list --format=freeze 2>/dev/null | grep -iE '^(torch|numpy|cuda|nvidia-cuda|sigmasplat|pytest)' >>"$OUT/machine.txt"
  cat "$OUT/machine.txt"
  TAIL=20 step doctor 180 "${sigmasplat[@]}" doctor
}
run_device() { TAIL=40 pytest device 300 -q tests/backend/test_cuda*_device.py tests/backend/test_on_a_device.py; }
run_tests() {
  local many=()
  "$PYTHON" -c 'import xdist' 2>/dev/null && many=(-n 6)
  TAIL=40 pytest tests 240 -q "${many[@]}" tests/backend -k "cuda or device or emulated"
}
run_memcheck() { sanitizer memcheck 240 memcheck "not very_many"; }
run_racecheck() { sanitizer racecheck 150 racecheck "identical"; }
run_slam() {
  step slam 240 "${sigmasplat[@]}" run synthetic:frames=200,width=640,height=480 --set backend=cuda --set input.width=640 \
    --out "$OUT/slam-run"
  cp "$OUT/slam-run/metrics.json" "$OUT/slam.json" 2>/dev/null
  rm -rf "$OUT/slam-run"
}
# gsplat is compiled when first used; a build that fails or takes too long is not tried again by the benchmark.
run_peer() {
  "$PYTHON" -c 'import gsplat' 2>/dev/null || { echo "peer: gsplat is not installed" | tee -a "$OUT/summary.txt"; return; }
  step peer 300 "$PYTHON" -c 'from gsplat.cuda._backend import _C; assert _C is not None, "no nvcc"'
  grep -q "^peer: exit 0" "$OUT/summary.txt" || ALONE=--alone
}
run_benchmark() { TAIL=60 step benchmark 420 "$PYTHON" benchmarks/gpu.py --out "$OUT" ${ALONE:-}; }
run_kernels() { TAIL=60 step kernels 60 "$PYTHON" benchmarks/kernels.py; }
run_profile() {
  step profile 150 "$NCU" --clock-control none --set basic --kernel-name "regex:blend|records|chain|pack|list_pairs|ssim|losses|adam" \
    --launch-skip 60 --launch-count 30 "$PYTHON" benchmarks/gpu.py --quick
}

if [ "${1:-}" = prepare ]; then
  prepare "${@:2}"
  exit
fi
mkdir -p "$OUT"
OUT=$(cd "$OUT" && pwd)
put_wheels_first
: >"$OUT/summary.txt"
for name in ${*:-$STEPS}; do
  if declare -F "run_$name" >/dev/null; then "run_$name"; else echo "no step $name; there are: $STEPS" >&2; fi
done
echo "== summary, in $OUT"
cat "$OUT/summary.txt"
