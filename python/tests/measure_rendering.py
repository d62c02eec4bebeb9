"""What draws of offsets cost and gain: `python python/tests/measure_rendering.py M.safetensors`. The tables are in docs/rendering.md."""

import sys
import tempfile
import time

import mitsuba as mi
import numpy as np

import acquire
import acquire.mitsuba
from acquire.mitsuba._factors import offset_weights

MM_PER_UV = 100.0


def spread(estimates):
    """Root mean square over places of the standard deviation of one draw over the mean."""
    mean, deviation = estimates.mean(1), estimates.std(1)
    return float(np.sqrt(np.mean((deviation / np.maximum(mean, 1e-12)) ** 2)))


def draws(material, places=200, n=2000, seed=1):
    """Exitance under even light at places, one draw at a time, by three densities of offsets."""
    rng = np.random.default_rng(seed)
    x0, x1, y0, y1 = material.lit_extent_mm
    window, pitch = np.array(material.info["window"]), material.info["pitch_mm"]
    half = window * pitch / 2
    # Places whose whole window is lit.
    x_o = rng.uniform([x0 + half[0] + 1, y0 + half[1] + 1], [x1 - half[0] - 1, y1 - half[1] - 1], (places, 2))[:, None]
    p = offset_weights(material)
    y, x = (pitch * (np.mgrid[0 : window[1], 0 : window[0]] - (window[::-1] // 2)[:, None, None]))
    length = (p * np.hypot(x, y)).sum() / p.sum()

    def by(offsets, density):
        inside = (np.abs(offsets) <= half).all(-1)
        response = material.response((x_o - offsets).reshape(-1, 2), np.broadcast_to(x_o, offsets.shape).reshape(-1, 2))
        return np.where(inside, response.mean(-1).reshape(offsets.shape[:2]) / density, 0)

    even = rng.uniform(-half, half, (places, n, 2))
    r, angle = rng.exponential(length, (places, n)), rng.uniform(0, 2 * np.pi, (places, n))
    ring = np.stack([r * np.cos(angle), r * np.sin(angle)], -1)
    k = rng.choice(p.size, (places, n), p=p.ravel() / p.sum())
    tent = rng.uniform(-0.5, 0.5, (2, places, n, 2)).sum(0)
    sample = np.stack([k % window[0], k // window[0]], -1)
    mean_row = (sample - window // 2 + tent) * pitch
    # The density of the tents is p between samples.
    at = np.clip(mean_row / pitch + window // 2, 0, window - 1)
    first = np.minimum(at.astype(int), window - 2)
    a, b = np.moveaxis(at - first, -1, 0)
    i, j = first[..., 0], first[..., 1]
    between = (p[j, i] * (1 - a) + p[j, i + 1] * a) * (1 - b) + (p[j + 1, i] * (1 - a) + p[j + 1, i + 1] * a) * b
    print(f"one draw, standard deviation over mean ({places} places, {n} draws):")
    print(f"  even over the window        {spread(by(even, 1 / np.prod(2 * half))):.2f}")
    print(f"  exponential, mean {length:.2f} mm    {spread(by(ring, np.exp(-r / length) / (2 * np.pi * length * np.maximum(r, 1e-9)))):.2f}")
    print(f"  mean row, interpolated      {spread(by(mean_row, between / pitch**2)):.2f}")


def pictures(file, runs=6, spp=64, pixels=64):
    """Noise of a picture and its time, for numbers of candidates: the slab under a sky."""
    with tempfile.TemporaryDirectory() as folder:
        places = MM_PER_UV * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        mesh = mi.Mesh("plate", 4, 2, has_vertex_texcoords=True)
        values = mi.traverse(mesh)
        values["vertex_positions"], values["vertex_texcoords"] = places.ravel().astype(np.float32), (places[:, :2] / MM_PER_UV).ravel().astype(np.float32)
        values["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
        values.update()
        mesh.write_ply(f"{folder}/plate.ply")
        for candidates in (1, 2, 4, 8):
            scene = mi.load_dict(_scene(f"{folder}/plate.ply", file, candidates, pixels))
            mi.render(scene, spp=spp)  # compiles
            before, each = time.process_time(), []
            for seed in range(runs):
                each.append(np.array(mi.render(scene, spp=spp, seed=seed)))
            took = (time.process_time() - before) / runs
            each = np.array(each)
            noise = float(np.sqrt((each.std(0, ddof=1) ** 2).mean()) / each.mean() * np.sqrt(spp))
            print(f"  candidates {candidates}: noise of one path {noise:.2f}, {1e9 * took / (pixels**2 * spp):.0f} ns of processor a path, noise² · time {noise**2 * took:.3f}")


def _scene(plate, file, candidates, pixels):
    middle = MM_PER_UV / 2
    above = mi.ScalarTransform4f().look_at([middle, middle, 50], [middle, middle, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale([25, 25, 1])
    return {
        "type": "scene",
        "integrator": {"type": "acquire_path", "candidates": candidates, "max_depth": 2},
        "sensor": {"type": "orthographic", "to_world": above, "film": {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}}},
        "slab": {"type": "ply", "filename": plate, "bsdf": {"type": "acquire_slab", "filename": file, "mm_per_uv": MM_PER_UV, "coat": False}},
        "sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 1.0}},
    }


if __name__ == "__main__":
    acquire.mitsuba.use()
    loaded = acquire.Material.load(sys.argv[1])
    print(loaded)
    draws(loaded)
    print("a flat slab under even light:")
    pictures(sys.argv[1])
