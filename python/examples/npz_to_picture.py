"""From responses in an NPZ archive to a picture of the slab under a light.

    python npz_to_picture.py [FOLDER]

Writes windows.npz, slab.rd.zarr, slab.safetensors and relit.npy (and relit.png where matplotlib is installed) into FOLDER, by default the working directory.
"""

import sys
from pathlib import Path

import numpy as np

import acquire

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")

# Responses that somebody measured or simulated: 24 × 16 lit points (x × y) a millimetre apart, windows of 21 × 21 samples of half a millimetre, mm⁻².
# Light spreads further in the right half of the slab, and further in red than in blue.
y, x = np.mgrid[0:16, 0:24]
dy, dx = 0.5 * (np.mgrid[0:21, 0:21] - 10)
spread_mm = np.where(x < 12, 0.6, 1.2)[..., None, None, None] * np.array([1.2, 1.0, 0.7])
fall = np.exp(-np.hypot(dx, dy)[..., None] / spread_mm)
response = 0.6 * fall / (fall.sum((2, 3), keepdims=True) * 0.5**2)  # an albedo of 0.6
np.savez(folder / "windows.npz", response=response, pitch_mm=0.5, lit_pitch_mm=1.0)

# To a matrix store, and its material.
report = acquire.import_matrix(folder / "windows.npz", folder / "slab.rd.zarr", force=True)
print(f"{report['points']} points, {100 * report['measured_share']:.0f} % measured")
material = acquire.factor(folder / "slab.rd.zarr", target_psnr=55)
print(f"{material}: psnr_db {material.report['psnr_db']:.1f}")
material.save(folder / "slab.safetensors", force=True)

# R at points in millimetres, and draws for a renderer.
print("R a millimetre to the right of two points, mm⁻²:", material.response([[6.0, 8.0], [18.0, 8.0]], [[7.0, 8.0], [19.0, 8.0]])[:, 0])
offsets, densities = material.sample((18.0, 8.0), 1000, seed=1)
print(f"mean length of 1000 draws: {np.hypot(*offsets.T).mean():.2f} mm")

# The slab under a slit of light across both halves.
x0, x1, y0, y1 = material.lit_extent_mm
light = np.zeros((64, 96))
light[28:36] = 1
relit = material.relight(light)
np.save(folder / "relit.npy", relit.values)
print(f"{relit.values.shape} samples, brightest {relit.values.max():.3f} of the irradiance")
try:
    import matplotlib.pyplot as plt
except ImportError:
    pass
else:
    picture = np.clip(relit.values / relit.values.max(), 0, 1) ** (1 / 2.2)
    plt.imsave(folder / "relit.png", picture)
