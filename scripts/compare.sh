#!/usr/bin/env bash
# Two revisions beside each other: time, memory, sizes and errors. docs/testing.md; scripts/compare.sh --help.
# Needs Python 3.11 or later (standard library), git, and what the build needs (scripts/setup.sh).
set -euo pipefail
if ! python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    echo "error: compare.sh needs python3, 3.11 or later" >&2
    exit 1
fi
exec python3 -B "$(dirname "$0")/compare.py" "$@"
