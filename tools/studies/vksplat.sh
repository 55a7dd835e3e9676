#!/bin/bash
# vksplat.sh SCENE STEPS [default|mcmc]: a peer of tools.studies.waiting. Times VkSplat's training process alone and
# prints its scores as a line of JSON. ANCHORS is the folder of its sources, where `run.sh SET.npz 100` has built it.
set -euo pipefail
build=${VKSPLAT_BUILD:-/tmp/vksplat_build} python=${PY:-python3} anchors=${ANCHORS:-../shared/anchors/vksplat}
out=$build/out/$(basename "$1").$2.${3:-default}
mkdir -p "$out"
icd=/usr/local/nvidia/share/vulkan/icd.d/nvidia_icd.json
[ ! -f $icd ] || export VK_DRIVER_FILES=$icd
begin=$(date +%s%N)
"$python" "$build/src/train_vksplat.py" "$1" "$out" --iterations "$2" --strategy "${3:-default}" --cap 200000 >"$out.log" 2>&1
seconds=$(($(date +%s%N) - begin))
"$python" "$anchors/score.py" "$1" "$out" | "$python" -c "
import json, sys
print(json.dumps({**json.loads(sys.stdin.read().splitlines()[-1]), 'process_seconds': $seconds / 1e9}))"
