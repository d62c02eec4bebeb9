#!/bin/sh
# get_mcml.sh DIR: fetch MCML 1.2.2 (Wang & Jacques) from its author's repository at a fixed commit, check, build DIR/mcml
# and DIR/mcml_xoshiro (same code, another random generator: see README). MCML_BASE overrides the source.
# The download was NOT tested (no route to GitHub from our machine); check and build were, with MCML_BASE=file://...
set -eu
here=$(cd "$(dirname "$0")" && pwd); d=$1; mkdir -p "$d"; cd "$d"
base=${MCML_BASE:-https://raw.githubusercontent.com/lhvwang/MCML/89b03dc370b6a70e3e6464bb5cf13907f64caa8f/mcR5pc}
for f in MCML.H MCMLGO.C MCMLIO.C MCMLMAIN.C MCMLNR.C; do
  l=$(echo $f | tr A-Z a-z); curl -fsSL "$base/$f" | tr -d '\r' > $l
done
# sums of the LF-terminated text that we measured
sha256sum -c <<S
574a94d97759d4fd968a5a6c72ab1f329b307720bec61411055accc1133d610c  mcml.h
635ef0a37b87324fd5220108b3af65ea510814bd5f1df98bf1f2eee9c384aece  mcmlgo.c
5d53ecc637f3c0da77865574df1178e4e43484c0f8974e96345993eeb865dd34  mcmlio.c
1b494f8b111cc58ae79fc8874abe24795b14ac89049cbc0d2923e98262154a0e  mcmlmain.c
7e470165711ad7a8f7d1327b8d4da9f2bf2dd9dbb7121f6f5e439f47859e385f  mcmlnr.c
S
gcc -w -O3 -march=native -o mcml mcmlmain.c mcmlgo.c mcmlio.c mcmlnr.c -lm
mkdir -p x; cp *.[ch] x/; python3 "$here/swap_rng.py" x/mcmlgo.c
gcc -w -O3 -march=native -o mcml_xoshiro x/mcmlmain.c x/mcmlgo.c x/mcmlio.c x/mcmlnr.c -lm
