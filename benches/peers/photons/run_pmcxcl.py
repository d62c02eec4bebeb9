#!/usr/bin/env python3
# requirements: pmcxcl==0.7.5 numpy==2.4.6 ; apt: pocl-opencl-icd (3.1-3+deb12u1)
"""pmcxcl (MCX-CL on pocl) on the two slabs. usage: run_pmcxcl.py b|c nphoton seed [json of further cfg]
The wheel and Debian's pocl clash over libstdc++ (symptom: 'stdint.h' file not found), so run it as
  LD_PRELOAD=/usr/lib/x86_64-linux-gnu/libstdc++.so.6 POCL_MAX_PTHREAD_COUNT=2 python run_pmcxcl.py b 1e6 1
One thread: POCL_MAX_PTHREAD_COUNT=1 taskset -c 0. The kernel is cached after the first run. Specular is added by hand:
the source starts inside the slab (isspecular off), so totals are scaled by 1 - Rsp."""
import json, resource, sys, time
import numpy as np
import pmcxcl

case, n, seed = sys.argv[1], int(float(sys.argv[2])), int(sys.argv[3])
if case == "b":      # three layers, mm
    h, w = 0.1, 400
    layers = [(1, 10), (2, 10), (3, 20)]
    prop = [[0, 0, 1, 1], [0.1, 10, 0.9, 1.37], [0.1, 1, 0, 1.37], [0.2, 1, 0.7, 1.37]]
elif case == "c":    # marble green, 5 mm
    h, w = 0.5, 160
    layers = [(1, 10)]
    prop = [[0, 0, 1, 1], [0.0041, 2.62, 0, 1.5]]
vol = np.zeros((w, w, 2 + sum(k for _, k in layers)), np.uint8)
z = 1
for lab, k in layers:
    vol[:, :, z:z + k] = lab
    z += k
cfg = dict(nphoton=n, vol=vol, prop=np.array(prop, float), unitinmm=h, tstart=0, tend=1e-7, tstep=1e-7,
           srcpos=[w / 2, w / 2, 1.0], srcdir=[0, 0, 1], issrcfrom0=1, isreflect=1, isspecular=0,
           issaveref=1, isnormalized=0, seed=seed, autopilot=1, outputtype="energy", gpuid=1)
cfg.update(json.loads(sys.argv[4]) if len(sys.argv) > 4 else {})
cpu = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
c0, t0 = cpu(), time.perf_counter()
res = pmcxcl.run(cfg)
wall, c1 = time.perf_counter() - t0, cpu() - c0
st = {k: v for k, v in res["stat"].items() if k not in ("workload",)}
ni = prop[1][3]
rsp = ((ni - 1) / (ni + 1)) ** 2
dref = np.asarray(res["dref"], float).reshape(vol.shape)
tot = st["energytot"]
s = (1 - rsp) / tot
R, T, A = dref[:, :, 0].sum() * s, dref[:, :, -1].sum() * s, np.asarray(res["flux"], float).sum() * s
print(f"case {case} n {n} wall {wall:.3f} s  {n/wall:.4g} ph/s wall, {n/st['runtime']*1e3:.4g} ph/s by its own runtime, {n/c1:.4g} ph per CPU-s (build included)  Rd {R:.5f} T {T:.5f} A {A:.5f} Rsp {rsp:.7f} sum {R+T+A+rsp:.5f}")
