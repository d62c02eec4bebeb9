#!/bin/sh
# Writes the stacks, installs the peers and compares all merges on the same code values.
# benches/peers/hdr/run.sh [PIXELS]
set -e
cd "$(dirname "$0")/../../.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
ACQUIRE_STACK="$work/stack" cargo bench --quiet --bench merge -- "${1:-40000}"
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --requirement benches/peers/hdr/requirements.txt
"$work/venv/bin/python" benches/peers/hdr/compare.py "$work/stack"
