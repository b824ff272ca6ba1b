#!/usr/bin/env bash
# Take the CUDA backend to a GPU: examine, test, time, profile, run, look for errors of memory. benchmarks/GPU.md explains.
#
#   benchmarks/flight.sh prepare            # what a machine without a network lacks, into .flight/; prints the two calls
#   benchmarks/flight.sh calls              # checks the sizes, and prints the two calls again
#   benchmarks/flight.sh a                  # first call: doctor device bench profile sigma varsplat cgslam
#   benchmarks/flight.sh b                  # second call: ncu memcheck racecheck
#   benchmarks/flight.sh b device bench     # any steps, in the time of that call
#   benchmarks/flight.sh land ARCHIVE…      # copies the results that came back into benchmarks/results
#   benchmarks/flight.sh --rehearse [STEP…] # both calls without a device, on its stand-in, in small
#
# A step that fails or takes too long does not stop the next one. After each step $OUT/flight-a.tar.gz (or -b) is written
# again: logs, figures, and in results/ the files to commit.
#
# OUT=FOLDER        where to write (runs/flight)
# PYTHON=python3    the interpreter that has torch; in prepare, that of a development install
# PATIENCE=1        multiplies every limit of time; LIMIT_doctor=60 sets one, in seconds
# FLIGHT=.flight    what `prepare` made
# DATA=FOLDER       in prepare: livingroom and fr1_xyz ($SIGMASPLAT_DATA, else ../shared/data)
set -uo pipefail
cd "$(dirname "$0")/.."
OUT=${OUT:-runs/flight}
PYTHON=${PYTHON:-$(command -v .venv/bin/python || echo python3)}
PATIENCE=${PATIENCE:-1}
FLIGHT=${FLIGHT:-.flight}
export PYTHONUNBUFFERED=1
declare -A CALL=([a]=420 [b]=300)
declare -A STEPS=([a]="doctor device bench profile sigma varsplat cgslam" [b]="ncu memcheck racecheck")
declare -A LIMIT=(
  [doctor]=30 [device]=150 [bench]=70 [profile]=30 [sigma]=40 [varsplat]=45 [cgslam]=35 [ncu]=60 [memcheck]=90 [racecheck]=60
)
RESERVE=8 # seconds of a call for the last archive
MOST_MIB=64
FRAMES=(livingroom:80 fr1_xyz:60) # rendered frames and real ones, of each recording the first

# Not in the lent machine's image (/work/.library/device/KINDS.md there), and gsplat, which is timed beside us (Apache-2.0).
NEEDED="tyro docstring_parser typeguard fast-simplification xatlas gsplat==1.5.3"
MACHINE="--python-version 3.12 --implementation cp --abi cp312 --abi abi3 --abi none"
for glibc in 2_28 2_27 2_17 2_5; do MACHINE+=" --platform manylinux_${glibc}_x86_64"; done
MACHINE+=" --platform manylinux2014_x86_64 --platform manylinux1_x86_64"
NVRTC=13.0.88 ARCHITECTURE=sm_90 # that machine's; a cubin of another compiler is not found in its cache

# ---- before ----

python312() { # the first Python from 3.12 on, whose wheel all later ones take; a pyenv shim may not answer
  local found
  for found in python3.12 "$HOME"/.pyenv/versions/3.12.*/bin/python3.12 python3.13 python3; do
    "$found" -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null && { echo "$found"; return; }
  done
  echo "flight.sh: no Python from 3.12 on; install one (pyenv install 3.12)" >&2
  return 1
}

prepare() {
  local data=${DATA:-${SIGMASPLAT_DATA:-../shared/data}} python tools=build/nvrtc
  python=$(python312) || return 1
  make wheel PYTHON="$("$python" -c 'import sys; print(sys.executable)')" || return 1
  rm -rf "$FLIGHT" && mkdir -p "$FLIGHT/wheels" "$FLIGHT/cubins" "$FLIGHT/frames" || return 1
  cp "$(ls -t dist/sigmasplat-*-cp312-abi3-*.whl | head -n 1)" "$FLIGHT/wheels/" || return 1
  for name in $NEEDED; do
    # shellcheck disable=SC2086
    "$PYTHON" -m pip download -q --no-deps --only-binary=:all: $MACHINE -c constraints.txt -d "$FLIGHT/wheels" "$name" || return 1
  done
  "$PYTHON" -m pip install -q --no-deps --upgrade --target "$tools" "nvidia-cuda-nvrtc==$NVRTC" || return 1
  tools=$(echo "$tools"/nvidia/*/lib)
  LD_LIBRARY_PATH=$tools PYTHONPATH=src "$PYTHON" - "$tools"/libnvrtc.so.?? "$FLIGHT/cubins" "$ARCHITECTURE" <<'CODE' || return 1
import ctypes, sys
from pathlib import Path
ctypes.CDLL(sys.argv[1])  # cuda-bindings takes the one that is loaded
from sigmasplat.plugins.cuda import cubins
for program in cubins.PROGRAMS:
    cubins.cubin(program, sys.argv[3], Path(sys.argv[2]))
print("compiled with NVRTC", cubins.compiler_version())
CODE
  for part in "${FRAMES[@]}"; do first_frames "$data/${part%:*}" "${part#*:}" "$FLIGHT/frames/${part%:*}" || return 1; done
  calls
}

first_frames() { # RECORDING COUNT TARGET: the first frames of a recording in TUM's layout
  mkdir -p "$3" && cp "$1/calibration.json" "$1/groundtruth.txt" "$3/" || return 1
  for list in rgb depth; do
    grep -v '^#' "$1/$list.txt" | head -n "$2" >"$3/$list.txt"
    awk '{print $2}' "$3/$list.txt" | tar c -C "$1" -T - | tar x -C "$3" || return 1
  done
  chmod -R u+w "$3"
}

calls() { # check what travels, and print what to give the device tool
  local bytes changed
  for folder in wheels cubins frames; do
    [ -n "$(ls -A "$FLIGHT/$folder" 2>/dev/null)" ] || { echo "flight.sh: $FLIGHT/$folder is empty; run prepare" >&2; return 1; }
  done
  bytes=$(($(git ls-files -zco --exclude-standard | du -cb --files0-from=- 2>/dev/null | tail -n 1 | cut -f 1) \
    + $(du -sb "$FLIGHT" | cut -f 1)))
  echo "$((bytes >> 20)) of $MOST_MIB MiB travel: the tree, and in $FLIGHT $(du -sh "$FLIGHT"/* | awk '{printf "%s %s, ", $2, $1}')"
  [ $((bytes >> 20)) -lt "$MOST_MIB" ] || { echo "flight.sh: too much; leave out frames (FRAMES)" >&2; return 1; }
  changed=$(git status --porcelain --untracked-files=no -- src CMakeLists.txt benchmarks | head -n 1)
  for call in a b; do
    printf '{"command": "FLIGHT_COMMIT=%s%s bash benchmarks/flight.sh %s", "carry": ["%s"], "timeout_s": %d}\n' \
      "$(git rev-parse HEAD)" "${changed:++}" $call "$FLIGHT" "${CALL[$call]}"
  done
}

land() {
  for archive in "$@"; do tar xzvf "$archive" -C benchmarks ./results || return 1; done
  "$PYTHON" benchmarks/tables.py
}

# ---- there ----

# The wheel brings the compiled module; sources of the checkout go over it. Compiled kernels go into the cache.
put_wheels_first() {
  ls "$FLIGHT"/wheels/*.whl >/dev/null 2>&1 || return 0
  local site
  site=${TMPDIR:-/tmp}/flight-$(cat "$FLIGHT"/wheels/* | sha1sum | cut -c 1-12)
  [ -d "$site/sigmasplat" ] || "$PYTHON" -m pip install -q --no-index --no-deps --no-compile --no-cache-dir \
    --target "$site" "$FLIGHT"/wheels/*.whl || return 1
  (cd src && find sigmasplat -name '*.so' -prune -o -name __pycache__ -prune -o -type f -print0 | tar c --null -T -) | tar x -C "$site"
  export PYTHONPATH=$site PATH=$site/bin:$PATH XDG_CACHE_HOME=$site/cache
  mkdir -p "$XDG_CACHE_HOME/sigmasplat/kernels" && cp "$FLIGHT"/cubins/* "$XDG_CACHE_HOME/sigmasplat/kernels/"
}

# step NAME COMMAND…: run it within its limit and the call's, keep what it says, sum it up in a line, pack everything.
step() {
  local name=$1 own=LIMIT_$1 left=$((END - SECONDS)) started=$SECONDS limit code said
  limit=${!own:-$((LIMIT[$name] * PATIENCE))}
  shift
  [ "$left" -lt "$limit" ] && limit=$left
  if [ -z "$1" ]; then
    said="left out, its program is not here"
  elif [ "$left" -lt 5 ]; then
    said="left out, no time is left"
  else
    echo "== $name, $limit s: $*"
    timeout --kill-after=5 "$limit" "$@" >"$WORK/$name.log" 2>&1
    code=$?
    tail -n "${TAIL:-12}" "$WORK/$name.log" | cut -c 1-300
    said="exit $code, $((SECONDS - started)) s"
    [ $code = 124 ] || [ $code = 137 ] && said="stopped after $limit s"
  fi
  echo "$name: $said" | tee -a "$WORK/summary.txt"
  pack
}

pack() { tar czf "$OUT/$ARCHIVE.part" -C "$WORK" . && mv "$OUT/$ARCHIVE.part" "$OUT/$ARCHIVE" && cp "$WORK/summary.txt" "$OUT/"; }
pytest() { step "$1" "${python[@]}" -m pytest -p no:cacheprovider "${@:2}"; }
slam() { # STEP PRESET SECONDS OPTIONS…
  step "$1" "${python[@]}" benchmarks/gpu_slam.py --preset "$2" --name "gpu-$2" --out "$WORK/results" --seconds $(($3 * PATIENCE)) \
    "${sizes[@]}" "${settings[@]}" "${@:4}"
}

run_doctor() {
  nvidia-smi --query-gpu=name,driver_version,memory.total,clocks.sm,clocks.mem --format=csv >"$WORK/machine.txt" 2>&1
  "$PYTHON" -m pip list --format=freeze 2>/dev/null | grep -iE '^(torch|numpy|cuda|nvidia-cuda|sigmasplat|pytest)' >>"$WORK/machine.txt"
  cat "$WORK/machine.txt"
  TAIL=20 step doctor "${python[@]}" -c 'import sys; from sigmasplat.cli import main; sys.exit(main())' doctor
}
run_device() { # in several processes: after an illegal address, every later test of a process fails
  TAIL=40 pytest device -v "${many[@]}" "${chosen[@]}" tests/backend/test_cuda*_device.py tests/backend/test_on_a_device.py
}
# gsplat is compiled when first used. It begins with the call, in a session of its own, and goes on beside the tests.
GSPLAT=${TMPDIR:-/tmp}/gsplat-compiled
compile_gsplat() {
  "$PYTHON" -c 'import importlib.util as u, sys; sys.exit(u.find_spec("gsplat") is None)' || return 0
  MAX_JOBS=$(($(nproc) > 4 ? $(nproc) - 4 : 1)) setsid sh -c \
    "$PYTHON -c 'from gsplat.cuda._backend import _C; assert _C is not None' && touch $GSPLAT" >"$GSPLAT.log" 2>&1 &
}
run_bench() { # waits a little for gsplat; without it, ours alone
  local alone=--alone wait
  for wait in {20..0}; do
    if [ -e "$GSPLAT" ]; then alone=""; break; fi
    [ -e "$GSPLAT.log" ] && [ "$wait" -gt 0 ] && sleep 1
  done
  cp "$GSPLAT.log" "$WORK/gsplat.log" 2>/dev/null
  # shellcheck disable=SC2086
  TAIL=30 step bench "${python[@]}" benchmarks/gpu.py --out "$WORK/results" "${scenes[@]}" $alone
}
run_profile() {
  TAIL=30 step profile "${python[@]}" benchmarks/gpu_profile.py --out "$WORK/results" --traces "$WORK/traces" "${scene[@]}"
}
run_sigma() { slam sigma sigma 6 --recordings "${recordings[@]}" --beside; }
run_varsplat() { slam varsplat varsplat-tum 30 --recordings "${recordings[-1]}"; }
run_cgslam() { slam cgslam cgslam-tum 20 --recordings "${recordings[-1]}"; }
run_ncu() {
  step ncu "${ncu[@]}" --clock-control none --set basic --section MemoryWorkloadAnalysis --section WarpStateStats --kill yes \
    --kernel-name "regex:blend|records|chain|pack|list_pairs|ssim|losses|adam|descend|align" --launch-skip 60 --launch-count 40 \
    "${python[@]}" benchmarks/gpu_profile.py --bare "${scene[@]}"
}
# Without torch's cache every tensor is memory of its own, whose bounds are watched. Graphs cannot be recorded then: none
# of these tests records one.
TESTS=tests/backend/test_cuda_device.py ALIGN=tests/backend/test_cuda_align_device.py
SIX=(
  "$TESTS::test_planes_rows_and_twist_agree[random-K7-ray]" "$TESTS::test_a_step_is_taken"
  "$TESTS::test_fits_are_those_of_the_cpu[1-3]" "$TESTS::test_the_tracking_loss_is_as_defined[kept]"
  "$ALIGN::test_normal_equations_are_the_cpus_and_those_of_the_residuals[huber-holes]"
  "$ALIGN::test_two_images_are_aligned_as_on_the_cpu[True-(161, 119)]"
)
sanitize() { # TOOL TESTS…
  PYTORCH_NO_CUDA_MEMORY_CACHING=1 step "$1" "${sanitizer[@]}" --tool "$1" --error-exitcode 9 --print-limit 20 \
    "${python[@]}" -m pytest -p no:cacheprovider -q "${@:2}"
}
run_memcheck() { sanitize memcheck "${SIX[@]}"; }
run_racecheck() { sanitize racecheck {"$TESTS","$ALIGN"}::test_two_runs_give_identical_bytes; }

fly() { # CALL STEP…
  local call=$1 name
  shift
  # shellcheck disable=SC2086
  [ $# -gt 0 ] || set -- ${STEPS[$call]}
  END=$((SECONDS + CALL[$call] * PATIENCE - RESERVE))
  ARCHIVE=flight-$call.tar.gz
  WORK=$(mktemp -d)
  mkdir -p "$WORK/results"
  if [ -z "$rehearsed" ]; then
    put_wheels_first || return 1
    [[ " $* " == *" bench "* ]] && compile_gsplat
  fi
  for name in "$@"; do
    if declare -F "run_$name" >/dev/null; then "run_$name"; else echo "no step $name; there are: ${STEPS[*]}" >&2; fi
  done
  echo "== $OUT/$ARCHIVE"
  cat "$WORK/summary.txt"
  rm -rf "$WORK"
}

first_of() { for found in "$@"; do [ -x "$found" ] && { echo "$found"; return; }; done; }
python=("$PYTHON") rehearsed="" chosen=() many=()
recordings=("$FLIGHT/frames/livingroom" "$FLIGHT/frames/fr1_xyz") sizes=(--frames 80) scene=() settings=()
scenes=(--splats 77000 300000 --sizes 640 480 --runs 50)
ncu=("$(first_of "$(command -v ncu)" /opt/nvidia/nsight-compute/*/ncu /usr/local/cuda*/bin/ncu)")
sanitizer=("$(first_of "$(command -v compute-sanitizer)" /usr/local/cuda*/bin/compute-sanitizer)")
case ${1:-} in
  prepare | calls | land) "$1" "${@:2}"; exit ;;
  a | b) calls=("$1") ;;
  --rehearse)
    rehearsed=yes calls=(a) python=("$PYTHON" tests/backend/rehearsal.py)
    [ $# -gt 1 ] || calls=(a b)
    ncu=("${python[@]}" --tool ncu) sanitizer=("${python[@]}" --tool compute-sanitizer)
    chosen=(-k "view_agrees") recordings=(synthetic:frames=200,width=48,height=36) sizes=(--width 48 --frames 2)
    settings=(--settings {mapping.{first_,},tracking.}iterations=1 seeding.first_{uniform,gradient}=50)
    scene=(--splats 60 --size 32 24) scenes=(--splats 60 --sizes 32 24 --runs 1) ;;
  *) sed -n '4,11s/^# *//p' "$0"; exit 2 ;;
esac
[ -n "$rehearsed" ] || ! "$PYTHON" -c 'import xdist' 2>/dev/null || many=(-n 4)
mkdir -p "$OUT"
OUT=$(cd "$OUT" && pwd)
for call in "${calls[@]}"; do fly "$call" "${@:2}"; done
