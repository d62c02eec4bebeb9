#!/usr/bin/env python3
# requirements: pmmc==0.3.12 numpy==2.4.6
"""pmmc (mesh-based MC, CPU) on the marble slab: a box of 6 tetrahedra. usage: run_pmmc.py nphoton seed [json of further cfg]
  LD_PRELOAD=/usr/lib/x86_64-linux-gnu/libstdc++.so.6 OMP_NUM_THREADS=1 taskset -c 0 python run_pmmc.py 3e5 1
compute="sse" is the CPU path (gpuid must be >= 1 all the same). Specular added by hand."""
import json, resource, sys, time
import numpy as np
import pmmc
n, seed = int(float(sys.argv[1])), int(sys.argv[2])
W, D = 80.0, 5.0
node = np.array([[x, y, z] for z in (0, D) for y in (0, W) for x in (0, W)], float)
elem = np.array([[0,1,3,7],[0,3,2,7],[0,2,6,7],[0,6,4,7],[0,4,5,7],[0,5,1,7]]) + 1
cfg = dict(nphoton=n, node=node, elem=elem, elemprop=np.ones(len(elem), int), tstart=0, tend=1e-7, tstep=1e-7,
           srcpos=[W / 2 + .123, W / 2 - .271, 0.0], srcdir=[0, 0, 1], prop=np.array([[0, 0, 1, 1], [0.0041, 2.62, 0, 1.5]], float),
           isreflect=1, issaveref=1, isnormalized=0, outputtype="energy", seed=seed, gpuid=1, compute="sse")
cfg.update(json.loads(sys.argv[3]) if len(sys.argv) > 3 else {})
cpu = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
c0, t0 = cpu(), time.perf_counter()
r = pmmc.run(cfg)
w, c = time.perf_counter() - t0, cpu() - c0
d = np.sort(np.asarray(r["dref"], float).ravel())[::-1]     # 12 outer triangles: 2 of the top, 2 of the bottom, 8 of the sides
sp = 0.04; k = (1 - sp) / n
print(f"c n {n} wall {w:.2f} s cpu {c:.2f} s  {n/w:.4g} ph/s wall  {n/c:.4g} ph per CPU-s  Rd {d[:2].sum()*k:.5f} T {d[2:4].sum()*k:.5f} sides {d[4:].sum()*k:.1e} A {np.asarray(r['flux'], float).sum()*k:.5f} Rsp {sp}")
