#!/bin/bash
# usage: [PHOTONS=1000000] [SLABS="a b c"] [CORE=0] bench_mcml.sh path/to/mcml [runs]
# One process on one core; wall and user seconds, photons/s by each, totals.
bin=$(realpath "$1"); runs=${2:-5}; d=$(mktemp -d); cd "$d"
N=${PHOTONS:-1000000}
mk() { # name dz dr nz nr na layer...   (file format A1 of MCML 1.2)
  n=$1; { echo 1.0; echo 1; echo "$n.mco A"; echo $N; echo "$2 $3"; echo "$4 $5 $6"; shift 6; echo $#; echo 1.0; printf '%s\n' "$@"; echo 1.0; } > $n.mci; }
#         n mua[/cm] mus[/cm] g d[cm]
mk a 0.001 0.01 20 50 30  "1.0 10 90 0.75 0.02"
mk b 0.01 0.01 40 50 30   "1.37 1 100 0.9 0.1" "1.37 1 10 0 0.1" "1.37 2 10 0.7 0.2"
mk c 0.01 0.01 50 200 30  "1.5 0.041 26.2 0 0.5"
TIMEFORMAT='%R %U'
for s in ${SLABS:-a b c}; do for i in $(seq $runs); do
  t=$( { time taskset -c ${CORE:-0} "$bin" $s.mci > /dev/null; } 2>&1 )
  awk -v s=$s -v t="$t" -v N=$N '/Specular/{sp=$1}/Diffuse/{rd=$1}/Absorbed/{a=$1}/#Transmittance \[/{tt=$1}
   END{split(t,q," ");printf "%s N %d wall %.2f s user %.2f s  %.0f ph/s wall  %.0f ph/s user  Rsp %s Rd %s A %s T %s\n",s,N,q[1],q[2],N/q[1],N/q[2],sp,rd,a,tt}' $s.mco
  sleep 1; done; done
rm -r "$d"
