#!/bin/sh
# Installs the pinned peers and factors one matrix with each of them, from disk to saved material.
# benches/peers/factor/run.sh STORE.rd.zarr [TERMS [DEGREE [PIPELINE...]]]
# One JSON line for each pipeline, then a table. Pipelines that would take hours on a large matrix are left out, which is
# said. ACQUIRE=target/release/acquire adds our own times; VENV keeps the installation.
set -e
here=$(cd "$(dirname "$0")" && pwd)
store=$(realpath "$1")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
venv=${VENV:-$work/venv}
if [ ! -x "$venv/bin/python" ]; then
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --requirement "$here/requirements.txt"
fi
PYTHONDONTWRITEBYTECODE=1 "$venv/bin/python" "$here/run_all.py" "$store" "$work" "${2:-15}" "${3:-7}" $(shift 3 2>/dev/null && echo "$@")
