#!/bin/sh
# Installs the pinned peers and factors one matrix with each of them, from disk to saved material.
# benches/peers/factor/run.sh STORE.rd.zarr [TERMS [DEGREE [PIPELINE...]]]
# One JSON line for each pipeline, then a table. Pipelines that would take hours on a large matrix are left out, which is
# said. ACQUIRE=target/release/acquire adds our own times; VENV keeps the installation.
set -e
here=$(cd "$(dirname "$0")" && pwd)
store=$(realpath "$1")
. "$here/../venv.sh"
PYTHONDONTWRITEBYTECODE=1 "$venv/bin/python" "$here/run_all.py" "$store" "$work" "${2:-15}" "${3:-7}" $(shift 3 2>/dev/null && echo "$@")
