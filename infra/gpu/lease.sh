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
# PRESET=default_gpu, sweep_gpu for the plane sweep, or hints_gpu for the model with the sweep's hints  SETTINGS="optimizer.groups=128 ..."  TEXTURES=FOLDER  SCENES=4 (held out, a family)  RESERVE=100
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
  local out=$1 seconds=${2:-560} preset=${PRESET:-default_gpu} name=default file=model prefix="" start leg settings=() bank_device=cpu
  if grep -q '^kind: sweep' "flows/training/presets/$preset.yaml"; then name=sweep file=sweep prefix=sweep_; fi
  # Hints are predicted by a network: by one process, on the GPU. They and the networks that take them are legs of their own.
  if grep -q 'hints: true' "flows/training/presets/$preset.yaml"; then prefix=hints_ bank_device=auto RANKS=1; fi
  start=cat3d_core/weights/$name.safetensors
  mkdir -p "$out" "$WORK"
  site
  leg=$(find "$WORK" -maxdepth 1 -name "${prefix}leg_*" | wc -l)
  for done in $(seq 0 $((leg - 1))); do
    if [ -f "$WORK/${prefix}leg_$done/$file.safetensors" ]; then start=$WORK/${prefix}leg_$done/$file.safetensors; fi
  done
  for setting in ${SETTINGS:-} "bank.folder=$WORK/${prefix}bank" "bank.seed=1" "seed=$((leg + 1))" ${TEXTURES:+"bank.textures=$TEXTURES"}; do
    settings+=(--set "$setting")
  done
  # Rendering is many small steps: all cores do it sooner than the GPU would.
  OMP_NUM_THREADS=1 "$PYTHON" -m torch.distributed.run --standalone --nproc-per-node "${RANKS:-$(nproc)}" -m flows.cli \
    train "$preset" --out "$WORK/${prefix}bank" --bank-only --device "$bank_device" "${settings[@]}"
  local left=$((seconds - SECONDS - ${RESERVE:-100}))
  if [ "$left" -lt 5 ]; then echo "The bank took $SECONDS s: no time is left to train in; ask for fewer bank.scenes." >&2; exit 1; fi
  "$PYTHON" -m flows.cli train "$preset" --out "$WORK/${prefix}leg_$leg" --start "$start" "${settings[@]}" \
    --minutes "$(awk "BEGIN { print $left / 60 }")"
  if [ "$name" = sweep ]; then
    "$PYTHON" -m infra.export_sweep "$WORK/sweep_leg_$leg" --to "$out/sweep.safetensors"
    if [ "${SCENES:-1}" -gt 0 ]; then
      "$PYTHON" -m flows.training.sweep_evaluation "$out/sweep.safetensors" --scenes "${SCENES:-1}" --cache "$WORK/sweep_bench" --json "$out/sweep.json"
    fi
    tar czf "$out/training.tar.gz" -C "$WORK/sweep_leg_$leg" training validation training.json
  else
    "$PYTHON" infra/export_default.py "$WORK/${prefix}leg_$leg" --scenes "${SCENES:-4}" --to "$out" --threads "$(nproc)"
    tar czf "$out/training.tar.gz" -C "$WORK/${prefix}leg_$leg" training samples training.json
  fi
  (cd "$out" && sha256sum $name.safetensors >$name.sha256 && split -b 15M -d $name.safetensors $name.part. && rm $name.safetensors)
  echo "Leg $leg: $SECONDS s in all, $left of them training, from $start. Left in $out:"
  ls -l "$out"
}

join() {
  local whole name=default
  if [ -f "$1/sweep.sha256" ]; then name=sweep; fi
  whole=$(mktemp -d)
  cat "$1"/$name.part.* >"$whole/$name.safetensors"
  (cd "$whole" && sha256sum --quiet -c -) <"$1/$name.sha256" # parts missing or damaged: stop before anything is replaced
  install -m 644 "$whole/$name.safetensors" "${2:-cat3d_core/weights}/$name.safetensors"
  if [ $name = default ]; then install -m 644 "$1/model_card.md" "${3:-docs/explanation}/model_card.md"; fi
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
