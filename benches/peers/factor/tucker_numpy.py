"""The tucker model in NumPy, for comparison: python tucker_numpy.py MATRIX.rd.zarr [terms] [degree]

Reads the store with zarr-python and writes nothing. Prints one JSON object with rel_rmse, which
`acquire factor MATRIX.rd.zarr --terms T --degree P` followed by `acquire evaluate` reproduces to 1e-4 relative.
Independent of the Rust code but for the definitions: peaks within a quarter of the window that exceed the centre by
three standard deviations, filling of unmeasured samples by the mean profile and two rounds of the ridge.
"""

import json
import sys
import time

import numpy as np
import zarr


def shifts(I, M, V, limit):
    n, h, w = I.shape
    cy, cx = h // 2, w // 2
    dy, dx = np.mgrid[:h, :w]
    far = (dy - cy) ** 2 + (dx - cx) ** 2
    near = (abs(dy - cy) <= limit[1]) & (abs(dx - cx) <= limit[0])
    out = np.zeros((n, 2), int)
    for i in range(n):
        if not M[i, cy, cx] or not (M[i] & near).any():
            continue
        values = np.where(M[i] & near, I[i], -np.inf)
        best = np.flatnonzero(values.ravel() == values.max())
        k = best[np.argmin(far.ravel()[best])]
        y, x = divmod(k, w)
        if I[i, y, x] - I[i, cy, cx] > 3 * np.sqrt(max(0, V[i, y, x] + V[i, cy, cx])):
            out[i] = x - cx, y - cy
    return out


def main(path, terms=15, degree=7):
    start = time.time()
    store = zarr.open_group(path, mode="r")
    R = store["response"][:].astype(float)
    var = store["variance"][:].astype(float)
    valid = store["valid"][:] != 0
    ny, nx, h, w, _ = R.shape
    n = ny * nx
    R, var, valid = R.reshape(n, h, w, 3), var.reshape(n, h, w, 3), valid.reshape(n, h, w, 3)
    M = valid.all(-1)
    I = np.where(M, R.mean(-1), 0)
    scale = np.where(M, I, 0).max((1, 2))
    live = scale > 0
    S = np.where(live[:, None], shifts(I, M, var.sum(-1) / 9, (w // 4, h // 4)), 0)
    rx, ry = abs(S).max(0)
    A = np.zeros((n, h + 2 * ry, w + 2 * rx))
    K = np.zeros(A.shape, bool)
    for i in np.flatnonzero(live):
        box = np.s_[i, ry - S[i, 1] : ry - S[i, 1] + h, rx - S[i, 0] : rx - S[i, 0] + w]
        A[box] = I[i] / scale[i]
        K[box] = M[i]
    H, W = A.shape[1:]
    A, K = A.reshape(n, -1), K.reshape(n, -1)
    assert K.any(0).all(), "a sample that no row measured: extend the mean profile first"
    mean = (A * K).sum(0) / K.sum(0)
    known = A * K
    relative = var.sum(-1) / 9 / np.where(live, scale, 1)[:, None, None] ** 2
    noise = max(1e-12, relative[M & live[:, None, None]].mean())
    F, ridge = mean[None], np.zeros(1)
    rounds = 0 if K[live].all() else 2
    for r in range(rounds + 1):
        for i in np.flatnonzero(live & ~K.all(1)):
            G = F[:, K[i]]
            c = np.linalg.solve(G @ G.T + np.diag(ridge), G @ known[i, K[i]])
            A[i] = np.where(K[i], known[i], c @ F)
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        F, ridge = Vt[:terms], noise / (s[:terms] ** 2 / n)
    fit = (U[:, :terms] * s[:terms]) @ Vt[:terms]
    error = size = 0.0
    low, high = fit[K].min(), fit[K].max()
    fit = fit.reshape(n, H, W)
    for i in range(n):
        E = fit[i, ry - S[i, 1] : ry - S[i, 1] + h, rx - S[i, 0] : rx - S[i, 0] + w]
        for c in range(3):
            v = valid[i, ..., c]
            y = R[i, ..., c][v]
            B = np.polynomial.legendre.legvander((2 * E[v] - low - high) / (high - low), degree)
            beta = np.linalg.lstsq(B, y, rcond=None)[0]
            error += ((B @ beta - y) ** 2).sum()
            size += (y**2).sum()
    print(json.dumps({"rel_rmse": float(np.sqrt(error / size)), "secs": round(time.time() - start, 2), "singular_values": s[:5].tolist()}))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:4]))
