#!/usr/bin/env bash
# Train the shipped model further, and check the GPU kernels, on a borrowed GPU: one command there, at most ten minutes.
#
#   bash infra/gpu/lease.sh wheels            # here, once: the packages that machine lacks, into .whl/ (never committed)
#   bash infra/gpu/lease.sh check OUT         # there: Triton kernel against float64, its speed, the paper's two jobs
#   bash infra/gpu/lease.sh train OUT 560     # there: bank, one leg of training, evaluation, all within 560 s
#   bash infra/gpu/lease.sh join OUT          # here: the parts of the model become the shipped one, with its card
#
# There: Python with torch, numpy, safetensors, pyarrow, PyYAML, rich and typer, and this folder with .whl/ in it. What is
# left in OUT is made to travel: few files of at most 15 MiB. Another `train` on the same machine is another leg, from the
# weights of the last one and on its bank; elsewhere a leg starts from the shipped weights.
#
# PRESET=default_gpu  SETTINGS="optimizer.groups=128 ..."  TEXTURES=FOLDER  SCENES=4 (held out, a family)  RESERVE=100
# (seconds kept for evaluating and packing)  RANKS (processes that render the bank; all cores)  WORK=outputs/lease  WHEELS=.whl
set -euo pipefail
cd "$(dirname "$0")/../.."
PYTHON=${PYTHON:-python3} WORK=$(realpath -m "${WORK:-outputs/lease}") WHEELS=${WHEELS:-.whl}
LACKING="pydantic pydantic_core annotated_types typing_inspection openimageio"

site() {
  if ls "$WHEELS"/*.whl >/dev/null 2>&1; then
    "$PYTHON" -m pip install -q --no-index --no-deps --no-compile --upgrade --target "$WORK/site" "$WHEELS"/*.whl
  fi
  export PYTHONPATH="$PWD:$WORK/site" PYTHONUNBUFFERED=1
}

wheels() {
  local platforms=()
  for name in manylinux_2_39 manylinux_2_28 manylinux_2_27 manylinux_2_17 manylinux2014; do platforms+=(--platform "${name}_x86_64"); done
  # shellcheck disable=SC2086
  "$PYTHON" -m pip download --no-deps --only-binary=:all: --python-version "${1:-3.12}" --implementation cp "${platforms[@]}" -c constraints.txt -d "$WHEELS" $LACKING
}

train() {
  local out=$1 seconds=${2:-560} preset=${PRESET:-default_gpu} start=cat3d_core/weights/default.safetensors leg settings=()
  mkdir -p "$out" "$WORK"
  site
  leg=$(find "$WORK" -maxdepth 1 -name 'leg_*' | wc -l)
  for done in $(seq 0 $((leg - 1))); do
    if [ -f "$WORK/leg_$done/model.safetensors" ]; then start=$WORK/leg_$done/model.safetensors; fi
  done
  for setting in ${SETTINGS:-} "bank.folder=$WORK/bank" "bank.seed=1" "seed=$((leg + 1))" ${TEXTURES:+"bank.textures=$TEXTURES"}; do
    settings+=(--set "$setting")
  done
  # Rendering is many small steps: all cores do it sooner than the GPU would.
  OMP_NUM_THREADS=1 "$PYTHON" -m torch.distributed.run --standalone --nproc-per-node "${RANKS:-$(nproc)}" -m flows.cli \
    train "$preset" --out "$WORK/bank" --bank-only --device cpu "${settings[@]}"
  local left=$((seconds - SECONDS - ${RESERVE:-100}))
  if [ "$left" -lt 5 ]; then echo "The bank took $SECONDS s: no time is left to train in; ask for fewer bank.scenes." >&2; exit 1; fi
  "$PYTHON" -m flows.cli train "$preset" --out "$WORK/leg_$leg" --start "$start" "${settings[@]}" \
    --minutes "$(awk "BEGIN { print $left / 60 }")"
  "$PYTHON" infra/export_default.py "$WORK/leg_$leg" --scenes "${SCENES:-4}" --to "$out" --threads "$(nproc)"
  tar czf "$out/training.tar.gz" -C "$WORK/leg_$leg" training samples training.json
  (cd "$out" && sha256sum default.safetensors >default.sha256 && split -b 15M -d default.safetensors default.part. && rm default.safetensors)
  echo "Leg $leg: $SECONDS s in all, $left of them training, from $start. Left in $out:"
  ls -l "$out"
}

join() {
  local whole
  whole=$(mktemp -d)
  cat "$1"/default.part.* >"$whole/default.safetensors"
  (cd "$whole" && sha256sum --quiet -c -) <"$1/default.sha256" # parts missing or damaged: stop before anything is replaced
  install -m 644 "$whole/default.safetensors" "${2:-cat3d_core/weights}/default.safetensors"
  install -m 644 "$1/model_card.md" "${3:-docs}/model_card.md"
  rm -r "$whole"
}

check() {
  mkdir -p "$1" "$WORK"
  site
  "$PYTHON" -m pytest -q --noconftest -p no:cacheprovider tests/core/zipnerf/test_hash_grid_triton.py -k compiled 2>&1 | tee "$1/kernel_test.log"
  "$PYTHON" -m flows.bench.gpu "$1" "${@:2}"
}

case "${1:-}" in
  wheels | train | join | check) "$@" ;;
  *) sed -n '2,/^set/p' "$0" | sed '$d'; exit 2 ;;
esac
