"""How far camera and projector are from where a matrix says that they are, for figures.py: as `registration_rms` of tests/all/geometry.rs."""

import math


def mapped(homography, p):
    x, y, w = (row[0] * p[0] + row[1] * p[1] + row[2] for row in homography)
    return x / w, y / w


def inverse(m):
    """Of a 3 × 3 matrix, up to a factor, which a homography does not see."""
    (a, b, c), (d, e, f), (g, h, i) = m
    return [[e * i - f * h, c * h - b * i, b * f - c * e],
            [f * g - d * i, a * i - c * g, c * d - a * f],
            [d * h - e * g, b * g - a * h, a * e - b * d]]


def distorted(lens, p):
    if lens is None:
        return p
    n = [(p[k] - lens["center_px"][k]) / lens["focal_px"] for k in range(2)]
    r2 = n[0] ** 2 + n[1] ** 2
    s = lens["focal_px"] * (1 + r2 * (lens["k1"] + r2 * lens["k2"]))
    return [lens["center_px"][k] + s * n[k] for k in range(2)]


def registration_rms(truth, found):
    """RMS per axis over 10 × 10 points of the slab, camera px and projector px."""
    camera = truth["camera_from_slab"]
    projector_from_slab = inverse(truth["slab_from_projector"])
    sums = [0.0, 0.0]
    for k in range(100):
        p = [2 * found["center_mm"][axis] * ((k % 10 if axis == 0 else k // 10) + 0.5) / 10 for axis in range(2)]
        true = [distorted(camera["lens"], mapped(camera["ideal_from_slab"], p)), distorted(truth.get("projector_lens"), mapped(projector_from_slab, p))]
        believed = [distorted(view["lens"], mapped(view["ideal_from_slab"], p)) for view in (found["view"], found["slab_from_projector"])]
        for which in range(2):
            sums[which] += sum((a - b) ** 2 for a, b in zip(true[which], believed[which])) / 200
    return [math.sqrt(s) for s in sums]
