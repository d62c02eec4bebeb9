#!/usr/bin/env python3
# requirements: iadpython==0.5.3 numpy==2.4.6 scipy==1.17.1   (python 3.11)
"""Reference totals of slabs by adding-doubling, printed as CSV.

Normal incidence, infinitely wide slab, unpolarized Fresnel faces, ambient n = 1,
Henyey-Greenstein. R and T are TOTAL: R includes the specular reflection of the first
face, T includes the unscattered light. r_specular is the first-face Fresnel value.

iadpython does the adding and doubling. Three parts of it are replaced here, because as
shipped (0.5.3) it is good to about 3 digits only and breaks from 64 quadrature points on:
  * the Radau quadrature (its weights go through explicit Legendre coefficients, and lose
    all digits above ~ 30 points) -> Gauss-Jacobi nodes;
  * the starting thickness (<= smallest node) -> THIN times smaller, diamond scheme always;
  * the Henyey-Greenstein matrix: the same delta-M sum, vectorized.
The table is made at three orders (default 64, 128, 256 points); `change` is the larger
of |dR|, |dT| between the last two: take it as the bound of the error.

usage: adding_doubling.py [--orders 32,64,128] [--thin 16]
"""
import argparse
import sys

import iadpython as iad
import iadpython.start
import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.special import roots_jacobi, roots_legendre

THIN = 16.0


def gauss(n, a, b):
    x, w = roots_legendre(n)
    return a + (b - a) * (x + 1) / 2, w * (b - a) / 2


def radau(n, a, b):
    """Radau quadrature that includes b: nodes of Jacobi (1, 0), weight 2/n^2 at the end."""
    x, w = roots_jacobi(n - 1, 1.0, 0.0)
    x, w = np.append(x, 1.0), np.append(w / (1 - x), 2 / n**2)
    return a + (b - a) * (x + 1) / 2, w * (b - a) / 2


def hg(sample):
    n, g = sample.quad_pts, sample.g
    k = np.arange(n)
    chi = (2 * k + 1) * (float(g) ** k - float(g) ** n) / (1 - float(g) ** n)
    p = legvander(sample.nu, n - 1)
    return (p * chi) @ p.T, (p * (chi * (-1.0) ** k)) @ p.T


def starting_thickness(sample):
    limit = sample.nu[0] / THIN
    if sample.b == np.inf:
        return limit
    d = sample.b_delta_M()
    return d * 0.5 ** max(0, int(np.ceil(np.log2(d / limit))))


def thinnest_layer(sample):
    sample.b_thinnest = starting_thickness(sample)
    return iadpython.start.diamond(sample)


iadpython.start.starting_thickness = starting_thickness
iadpython.start.thinnest_layer = thinnest_layer


def slab(mua, mus, g, n, d, order):
    """Total R and T. d = inf for a half-space."""
    mut = mua + mus
    s = iad.Sample(a=mus / mut, b=mut * d, g=g, n=n, quad_pts=order)
    if n == 1.0:
        s.nu, w = radau(order, 0.0, 1.0)
    else:
        nu_c = np.sqrt(1 - 1 / n**2)
        (x1, w1), (x2, w2) = gauss(order // 2, 0.0, nu_c), radau(order // 2, nu_c, 1.0)
        s.nu, w = np.append(x1, x2), np.append(w1, w2)
    s.twonuw = 2 * s.nu * w
    s.hp, s.hm = hg(s)
    r, t, _, _ = s.rt()
    return float(r), float(t)


def stack(layers, n, order):
    """Total R and T of layers (mua, mus, g, d) of one index n, in the order the light meets them."""
    nu_c = np.sqrt(1 - 1 / n**2)
    (x1, w1), (x2, w2) = gauss(order // 2, 0.0, nu_c), radau(order // 2, nu_c, 1.0)
    top = None
    for mua, mus, g, d in layers:
        s = iad.Sample(a=mus / (mua + mus), b=(mua + mus) * d, g=g, n=n, quad_pts=order)
        s.nu, s.twonuw = np.append(x1, x2), 2 * np.append(x1, x2) * np.append(w1, w2)
        s.hp, s.hm = hg(s)
        r, t = iad.simple_layer_matrices(s)
        top = (r, r, t, t) if top is None else iad.add_layers(s, top[0], top[1], top[2], top[3], r, r, t, t)
    r02, r20, t02, t20 = top
    r01, r10, t01, t10 = iadpython.start.boundary_layer(s, top=True)
    r02, r20, t02, t20 = iad.add_slide_above(s, r01, r10, t01, t10, r02, r20, t02, t20)
    r23, r32, t23, t32 = iadpython.start.boundary_layer(s, top=False)
    r03, r30, t03, t30 = iad.add_slide_below(s, r02, r20, t02, t20, r23, r32, t23, t32)
    return tuple(map(float, s.UX1_and_UXU(r03, t03)[:2]))


# Jensen et al. 2001, 1/mm: reduced scattering R,G,B; absorption R,G,B.
JENSEN = {
    "apple": ((2.29, 2.39, 1.97), (0.0030, 0.0034, 0.046)),
    "chicken1": ((0.15, 0.21, 0.38), (0.015, 0.077, 0.19)),
    "cream": ((7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163)),
    "ketchup": ((0.18, 0.07, 0.03), (0.061, 0.97, 1.45)),
    "marble": ((2.19, 2.62, 3.00), (0.0021, 0.0041, 0.0071)),
    "potato": ((0.68, 0.70, 0.55), (0.0024, 0.0090, 0.12)),
    "skimmilk": ((0.70, 1.22, 1.90), (0.0014, 0.0025, 0.0142)),
    "skin1": ((0.74, 0.88, 1.01), (0.032, 0.17, 0.48)),
    "skin2": ((1.09, 1.59, 1.79), (0.013, 0.070, 0.145)),
    "chicken2": ((0.19, 0.25, 0.32), (0.018, 0.088, 0.20)),
    "spectralon": ((11.6, 20.4, 14.9), (0.0, 0.0, 0.0)),
    "wholemilk": ((2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014)),
}


def cases():
    inf = float("inf")
    # name, channel, mua, mus, g, n, d   (cm for the first two, mm for the others)
    yield "vandehulst_n1_slab[cm]", "-", 10.0, 90.0, 0.75, 1.0, 0.02
    yield "giovanelli_halfspace[cm]", "-", 10.0, 90.0, 0.0, 1.5, inf
    def medium(name, d, g):
        n = 1.5 if name == "marble" else 1.3
        for c, musp, mua in zip("RGB", *JENSEN[name]):
            yield f"{name}_{d:g}mm", c, mua, musp / (1 - g), g, n, d
    yield from medium("marble", 5.0, 0.0)
    for name in JENSEN:
        yield from medium(name, 4.0, 0.0)
    for name in ("skin1", "marble"):
        yield from medium(name, 4.0, 0.8)
    yield from medium("marble", 5.0, 0.8)


def main():
    global THIN
    ap = argparse.ArgumentParser()
    ap.add_argument("--orders", default="64,128,256")
    ap.add_argument("--thin", type=float, default=THIN)
    a = ap.parse_args()
    THIN = a.thin
    orders = [int(o) for o in a.orders.split(",")]
    print("slab,channel,mua,mus,g,n,d,r_specular,R_total,T_total,A,change")
    layers = [(1.0, 100.0, 0.9, 0.1), (1.0, 10.0, 0.0, 0.1), (2.0, 10.0, 0.7, 0.2)]  # 1/cm, cm
    rt = [stack(layers, 1.37, o) for o in orders]
    r, t = rt[-1]
    change = max(abs(x - y) for x, y in zip(rt[-1], rt[-2])) if len(rt) > 1 else float("nan")
    print(f"mcml_three_layers[cm],-,,,,1.37,0.4,{(0.37 / 2.37) ** 2:.6f},{r:.6f},{t:.6f},{1 - r - t:.6f},{change:.1e}")
    for name, c, mua, mus, g, n, d in cases():
        rt = [slab(mua, mus, g, n, d, o) for o in orders]
        r, t = rt[-1]
        change = max(abs(x - y) for x, y in zip(rt[-1], rt[-2])) if len(rt) > 1 else float("nan")
        spec = ((n - 1) / (n + 1)) ** 2
        print(f"{name},{c},{mua:g},{mus:g},{g:g},{n:g},{d:g},{spec:.6f},{r:.6f},{t:.6f},{1 - r - t:.6f},{change:.1e}")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
