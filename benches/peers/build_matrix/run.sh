#!/bin/sh
# Installs the pinned peer, and builds the matrix of one simulated capture by it and by `acquire`, in turn.
# benches/peers/build_matrix/run.sh CAPTURE [ROUNDS]
# ACQUIRE=target/release/acquire names the program; VENV keeps the installation.
set -e
here=$(cd "$(dirname "$0")" && pwd)
capture=$(realpath "$1")
acquire=$(realpath "${ACQUIRE:-$here/../../../target/release/acquire}")
. "$here/../venv.sh"
PYTHONDONTWRITEBYTECODE=1 "$venv/bin/python" "$here/run_all.py" "$acquire" "$capture" "$work" "${2:-3}"
