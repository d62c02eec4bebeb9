"""A matrix store in xarray and dask: sums without loading it, a crop, and back.

    python matrix_in_xarray.py [FOLDER]

Needs xarray, zarr 3 and dask. Simulates a small matrix in FOLDER, by default the working directory.
"""

import sys
from pathlib import Path

import acquire

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
acquire.simulate(folder / "capture", material="chessboard-2x2", grid=(12, 9), window=(11, 11), seed=1, truth_only=True, force=True)
matrix = acquire.Matrix.open(folder / "capture/truth.rd.zarr")
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
