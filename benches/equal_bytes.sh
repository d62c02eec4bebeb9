#!/bin/sh
# Models at equal bytes_f32, and coded at equal psnr_db: benches/equal_bytes.sh MATRIX.rd.zarr …
# The budget is that of tucker with T = 15 and P = 7. ACQUIRE names the program.
set -eu
ACQUIRE=${ACQUIRE:-target/release/acquire}
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
measure() {
    "$ACQUIRE" evaluate "$2" "$3" --json --quiet >"$tmp/m.json"
    python3 - "$tmp/m.json" "$1" <<'P'
import json, sys
m = json.load(open(sys.argv[1]))
n = lambda v, d: "-" if v is None else f"{v:.{d}f}"
print(f"  {sys.argv[2]:<22} {m['bytes_f32']:>9} {m['bytes_file']:>9} {n(m['psnr_db'],2):>7} {n(m['log_rmse'],4):>7} {n(m['relit_psnr_db'],2):>7}")
P
}
field() { python3 -c "import json,sys; print(json.load(open(sys.argv[1]))[sys.argv[2]])" "$tmp/m.json" "$1"; }
for matrix in "$@"; do
    echo "$matrix"
    echo "  model                  bytes_f32      file psnr_db log_rmse relit_db"
    "$ACQUIRE" factor "$matrix" --model tucker --terms 15 --degree 7 --out "$tmp/t.safetensors" --quiet
    measure "tucker T=15 P=7" "$tmp/t.safetensors" "$matrix"
    bytes=$(field bytes_f32)
    psnr=$(field psnr_db)
    for model in "joint" "peers2006" "peers2006 --color-regression"; do
        # shellcheck disable=SC2086
        "$ACQUIRE" factor "$matrix" --model $model --max-bytes "$bytes" --out "$tmp/m.safetensors" --quiet
        measure "$model" "$tmp/m.safetensors" "$matrix"
    done
    "$ACQUIRE" factor "$matrix" --model joint --target-psnr "$psnr" --out "$tmp/m.acq" --quiet
    measure "joint coded, equal dB" "$tmp/m.acq" "$matrix"
    python3 -c "print(f'  coded is 1/{$bytes/$(field bytes_file):.1f} of tucker')"
done
