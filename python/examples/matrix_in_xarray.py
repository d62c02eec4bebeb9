"""A matrix store in xarray and dask: sums without loading it, a crop, and back.

    python matrix_in_xarray.py [FOLDER]

Needs xarray, zarr 3 and dask. Works in FOLDER, by default the working directory.
"""

import sys
from pathlib import Path

import numpy as np

import acquire

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")

# A matrix of 12 × 9 lit points whose light spreads further from left to right.
dy, dx = 0.5 * (np.mgrid[0:11, 0:11] - 5)
spread_mm = np.linspace(0.5, 1.0, 12)[:, None, None, None] * np.array([1.2, 1.0, 0.7])
response = 0.05 * np.exp(-np.hypot(dx, dy)[..., None] / spread_mm)
acquire.write_matrix(folder / "slab.rd.zarr", np.broadcast_to(response, (9, *response.shape)), pitch_mm=0.5, force=True)
matrix = acquire.Matrix.open(folder / "slab.rd.zarr")
print(matrix)

lazy = matrix.to_xarray()
albedo = (lazy.response.sum(("dy", "dx")) * matrix.pitch_mm**2).compute()
print("share of the light that leaves within the window, by channel:", albedo.mean(("y_i", "x_i")).values)

# The lower half of the slab and the middle of the windows, as a store of its own.
lazy.isel(y_i=slice(4, None), dx=slice(2, -2), dy=slice(2, -2)).to_zarr(folder / "half.rd.zarr", mode="w")
half = acquire.Matrix.open(folder / "half.rd.zarr")
print(half)
material = acquire.factor(half)
print(material, acquire.evaluate(material, half)["psnr_db"])
