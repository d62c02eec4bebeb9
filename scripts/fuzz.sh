#!/bin/sh
# Mutated files for every reader, SECONDS a reader (default 60), in 4 GiB of address space: scripts/fuzz.sh 3600. See fuzz/README.md.
set -e
cd "$(dirname "$0")/.."
test=$(${CARGO:-cargo} test --release --locked --test fuzz --no-run --message-format=json | sed -n 's/.*"executable":"\([^"]*\/fuzz-[^"]*\)".*/\1/p')
ulimit -v 4194304
FUZZ_SECS=${1:-60} exec "$test" --ignored --nocapture --test-threads 1
