#!/usr/bin/env bash
# What only a GPU can show, in under ten minutes: bits of snapshot and replay, memory against the budget, waits of an
# update, seconds per update. Needs a CUDA device and gift-peft with torch for it; downloads nothing (random weights).
#   examples/tools/first_gpu_run.sh             writes first_gpu_run.md, one table to paste into an issue
#   examples/tools/first_gpu_run.sh out.md      the same elsewhere
set -euo pipefail
out="$(realpath -m "${1:-first_gpu_run.md}")"
cd "$(dirname "$0")"
python -c 'import torch, sys; sys.exit(0 if torch.cuda.is_available() else "there is no CUDA device")'
: > "$out"
for model in depth-anything-v2-large vggt-1b metric3d-v2-giant2; do
  # Each in a process of its own, so that one that fails or fills the memory leaves the others alone.
  timeout 190 python first_gpu_run.py --model "$model" >> "$out" || echo "| $model | failed, see above |" >> "$out"
done
cat "$out"
