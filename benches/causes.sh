#!/usr/bin/env bash
# Which cause of error costs how much: the table "What each costs" of docs/simulation.md.
#
#   cargo build --release && benches/causes.sh [FOLDER]      (a temporary one by default; rows as they come, warnings on stderr)
#
# Each cause alone on the default bench, then the everyday ones all together, then those switched off one at a time.
# GRID, WINDOW, SEED, MATERIAL and ACQUIRE can be set in the environment; ROWS=alone, together or all.
set -euo pipefail
here=$(dirname "$0")
acquire=${ACQUIRE:-${CARGO_TARGET_DIR:-$here/../target}/release/acquire}
folder=${1:-$(mktemp -d)}
mkdir -p "$folder"
bench=(--material "${MATERIAL:-chessboard-4x4}" --grid "${GRID:-9x7}" --window "${WINDOW:-33x29}" --seed "${SEED:-3}")
rows=${ROWS:-all}

# measure "LABEL" SIMULATE_OPTIONS… [-- BUILD_OPTIONS…]
measure() {
  local label=$1 capture=$folder/capture matrix=$folder/matrix.rd.zarr
  shift
  local simulate=()
  while [ $# -gt 0 ] && [ "$1" != -- ]; do simulate+=("$1"); shift; done
  [ $# -gt 0 ] && shift
  if ! "$acquire" simulate "$capture" --force -q "${bench[@]}" "${simulate[@]}" 2>"$folder/said" ||
    ! "$acquire" build-matrix "$capture" --out "$matrix" -q "$@" 2>"$folder/said"; then
    echo "| $label | | | | | $(grep -m1 error "$folder/said" || true) |"
    return
  fi
  while IFS= read -r line; do echo "$label: $line" >&2; done <"$folder/said"
  "$acquire" evaluate -q --json "$matrix" "$capture/truth.rd.zarr" >"$folder/measures.json"
  python3 - "$label" "$folder" <<'PY'
import json, sys
label, folder = sys.argv[1:]
m = json.load(open(folder + "/measures.json"))
warnings = sum(line.startswith("warning") for line in open(folder + "/said"))
print(f"| {label} | {100 * m['rel_rmse']:.2f} % | {m['log_rmse']:.3f} | {100 * m['coverage_2sigma']:.1f} % | {m['drift_rms_px']:.3f} | {warnings} |",
      flush=True)
PY
}

echo '| options | `rel_rmse` | `log_rmse` | `coverage_2sigma` | `drift_rms_px` | warnings |'
echo '|---|---|---|---|---|---|'
if [ "$rows" != together ]; then
  measure 'none: the default bench'
  measure '`--noise-free`' --noise-free
  measure '`--only` (ideal)' --only
  measure '`--only drift`' --only drift
  measure '`--only noise`' --only noise
  measure '`psf`, 0.5 px' --with psf
  measure '`--psf-px 0.25`' --psf-px 0.25
  measure '`glare`, 1 %' --with glare
  measure '`hot-pixels`, 10⁻⁵' --with hot-pixels
  measure '`hot-pixels`, 10⁻³' --hot-pixels 1e-3
  measure '`flicker`, 0.3 %' --with flicker
  measure '`jumps`, three of 1.5 px' --with jumps
  measure '`camera-drift`, 0.3 px' --with camera-drift
  measure '`camera-jumps`, three of 1 px' --with camera-jumps
  measure '`projector-distortion`, −0.01' --with projector-distortion
  measure '`exif`, 1/8 stop' --with exif
  measure '`exif`, estimated' --with exif --link-exposures -- --exposure-from estimate
  measure '`--format jpeg`' --format jpeg
  measure '`--response srgb` (16 bit)' --response srgb
  measure '`--response film` (16 bit)' --response film
  measure '`--response film --rig-response estimate`' --response film --rig-response estimate
  measure '`--response film --format jpeg`' --response film --format jpeg
  measure '`--response film --format jpeg --rig-response estimate`' --response film --format jpeg --rig-response estimate
  measure '`--rig-without-noise`' --rig-without-noise
  measure '`--sensor sony-a7r1`' --sensor sony-a7r1
  measure '`--sensor canon-t1`' --sensor canon-t1
  measure '`--sensor phone`' --sensor phone
  measure '`--bits 10`' --bits 10
  measure '`--bits 12`' --bits 12
  measure '`--bits 16`' --bits 16
fi
if [ "$rows" != alone ]; then
  together=(psf glare hot-pixels flicker jumps camera-drift camera-jumps projector-distortion)
  measure 'all eight together' --with "$(IFS=,; echo "${together[*]}")"
  for cause in "${together[@]}"; do
    rest=$(printf '%s\n' "${together[@]}" | grep -vx "$cause" | paste -sd,)
    measure "… without \`$cause\`" --with "$rest"
  done
  for cause in noise drift distortion vignetting ambient falloff projector-black blur; do
    measure "… without \`$cause\`" --with "$(IFS=,; echo "${together[*]}")" --without "$cause"
  done
  all=$(IFS=,; echo "${together[*]}")
  measure '… and `exif`, estimated' --with "$all,exif" --link-exposures -- --exposure-from estimate
  measure '… and JPEG' --with "$all" --format jpeg
  measure '… and JPEG, `film`, curve estimated' --with "$all,film" --format jpeg --rig-response estimate
fi
