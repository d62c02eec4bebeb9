#!/usr/bin/env bash
# How well matrices of Monte Carlo captures are measured, per material: the table "By Monte Carlo, per material" of docs/accuracy.md.
#
#   cargo build --release && benches/accuracy.sh [FOLDER]      (a temporary one by default; rows as they come, warnings on stderr)
#
# PHOTONS (2e5) a dot and channel; slabs that are the same everywhere are solved once, with the photons of all dots up to the simulator's limit.
# GRID, WINDOW, SEED, ACQUIRE and MATERIALS can be set in the environment.
set -euo pipefail
here=$(dirname "$0")
acquire=${ACQUIRE:-${CARGO_TARGET_DIR:-$here/../target}/release/acquire}
folder=${1:-$(mktemp -d)}
mkdir -p "$folder"
bench=(--grid "${GRID:-9x7}" --window "${WINDOW:-33x29}" --seed "${SEED:-3}" --transport mc)
photons=${PHOTONS:-200000}
materials=${MATERIALS:-homogeneous cream skin1 ketchup potato skim-milk layered chessboard-4x4 marble}

echo '| material | files | photon noise | `rel_rmse` | `log_rmse` | `coverage_2sigma` | `drift_rms_px` | `position_rms_px` |'
echo '|---|---|---|---|---|---|---|---|'
for material in $materials; do
  for format in png jpeg; do
    capture=$folder/$material-$format
    matrix=$capture.rd.zarr
    said=$("$acquire" simulate "$capture" --force --material "$material" "${bench[@]}" --photons "$photons" --format $format 2>&1)
    "$acquire" build-matrix "$capture" --out "$matrix" -q 2>"$capture.warnings" ||
      { echo "| \`$material\` | $format | | not built: $(tail -2 "$capture.warnings" | tr '\n' ' ') |"; continue; }
    sed "s/^/$material, $format: /" "$capture.warnings" >&2
    "$acquire" evaluate -q --json "$matrix" "$capture/truth.rd.zarr" >"$capture.json"
    python3 - "$material" "$format" "$said" "$capture.json" <<'PY'
import json, re, sys
material, files, said, path = sys.argv[1:]
m = json.load(open(path))
noise = re.search(r"noise[^\d]*([\d.]+ %)", said)
print(f"| `{material}` | {files} | {noise[1] if noise else ''} | {100 * m['rel_rmse']:.2f} % | {m['log_rmse']:.3f} "
      f"| {100 * m['coverage_2sigma']:.1f} % | {m['drift_rms_px']:.3f} | {m['position_rms_px']:.3f} |", flush=True)
PY
    printf '%s\n' "$said" >"$capture.said"
    rm -rf "$capture/photos"
  done
done
