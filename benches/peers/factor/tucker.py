"""The tucker model as fast as we can make it in Python: python tucker.py BACKEND COLOUR STORE OUT.npz TERMS DEGREE

What `acquire factor --model tucker` does, from disk to saved material: intensity, peak shift, normalization, filling of
what shifted rows miss of the common window (mean profile, then two rounds of the factorization), T terms, and a polynomial
per row and channel. BACKEND: randomized (scikit-learn), svds, gram (scipy), full (NumPy). COLOUR: normal (batched
normal equations in f64, Cholesky), qr (batched Householder QR), lstsq (numpy.linalg.lstsq row by row in processes).
Needs memory for 1.8 times the responses.
"""

import sys

import numpy as np
import zarr
from common import CORES, Clock, blocks, parallel, psnr_db, shared
from threadpoolctl import threadpool_limits

BLOCK = 16  # rows of a batch whose polynomials stay in the cache


class Rows:
    """All rows of a store: responses, intensity, where they go."""

    def __init__(self, path):
        zarr.config.set({"threading.max_workers": 1})  # each of ours waits for one chunk
        store = zarr.open_group(path, mode="r")
        self.source = [store[name] for name in ("response", "variance", "valid")]
        ny, self.nx, self.h, self.w, _ = self.source[0].shape
        self.n = ny * self.nx
        self.R = shared((self.n, self.h * self.w, 3))
        self.I = shared((self.n, self.h * self.w))
        self.M = shared((self.n, self.h * self.w), bool)
        self.scale, self.shift = shared(self.n, np.float64), shared((self.n, 2), np.int64)
        self.noise, self.count = shared(self.n, np.float64), shared(self.n, np.int64)
        cy, cx, ly, lx = self.h // 2, self.w // 2, self.h // 4, self.w // 4
        dy, dx = np.mgrid[-cy : cy + 1, -cx : cx + 1]
        near = np.flatnonzero((abs(dy) <= ly).ravel() & (abs(dx) <= lx).ravel())
        # Nearest to the centre first: of equal peaks argmax takes the first.
        self.near = near[np.argsort((dy**2 + dx**2).ravel()[near], kind="stable")]
        parallel(self.survey, blocks(self.source[0]))
        self.live = self.scale > 0
        self.noise_level = max(1e-12, self.noise.sum() / max(1, self.count[self.live].sum()))
        self.whole = bool(self.M.all())

    def survey(self, block):
        y, a, b = block
        at = slice(y * self.nx + a, y * self.nx + b)
        R, V, valid = (np.asarray(s[y, a:b]).reshape(b - a, -1, 3) for s in self.source)
        whole = valid.min() != 0
        M = np.ones(R.shape[:2], bool) if whole else (valid != 0).all(-1)
        I = R[..., 0] + R[..., 1]
        I += R[..., 2]
        I *= np.float32(1 / 3)
        if not whole:
            I *= M
        self.R[at], self.I[at], self.M[at] = R, I, M
        self.scale[at] = scale = np.maximum(0, I.max(1))
        near, row = self.near, np.arange(b - a)
        # Differences that f32 rounds away decide between peaks only where they are equal to seven digits.
        values = I[:, near] if whole else np.where(M[:, near], I[:, near], -np.inf)
        best = values.argmax(1)
        peak = near[best]
        f64 = lambda k: R[row, k].astype(float).sum(1) / 3
        v = lambda k: V[row, k].astype(float).sum(1) / 9
        with np.errstate(invalid="ignore"):
            far = f64(peak) - f64(near[0]) > 3 * np.sqrt(np.maximum(0, v(peak) + v(near[0])))
        moves = far & M[:, near[0]] & (scale > 0) & (best > 0)
        shift = np.stack([peak % self.w - self.w // 2, peak // self.w - self.h // 2], 1)
        self.shift[at] = np.where(moves[:, None], shift, 0)
        total = V.reshape(b - a, -1).sum(1) if whole else (V.sum(-1) * M).sum(1)
        self.noise[at] = np.where(scale > 0, total / 9 / np.where(scale > 0, scale, 1).astype(float) ** 2, 0)
        self.count[at] = M.sum(1)


class Window:
    """The common window of shifted rows, and the rows in groups of equal shift."""

    def __init__(self, rows):
        self.rows = rows
        self.rx, self.ry = abs(rows.shift).max(0)
        self.H, self.W = rows.h + 2 * self.ry, rows.w + 2 * self.rx
        moves, which = np.unique(rows.shift, axis=0, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        self.groups = list(zip(moves, np.split(order, np.cumsum(np.bincount(which.ravel()))[:-1])))

    def box(self, shift):
        y, x = self.ry - shift[1], self.rx - shift[0]
        return np.s_[..., y : y + self.rows.h, x : x + self.rows.w]

    def crop(self, vectors, shift):
        """Vectors [T, H W] over the samples that rows of this shift measured."""
        part = vectors.reshape(len(vectors), self.H, self.W)[self.box(shift)]
        return np.ascontiguousarray(part).reshape(len(vectors), -1)

    def parts(self, size):
        return [(s, g[k : k + size]) for s, g in self.groups for k in range(0, len(g), size)]

    def normalized(self):
        """Rows [N, H W] in float32, zero where not measured, and their mean profile."""
        rows, A = self.rows, shared((self.rows.n, self.H, self.W))
        inverse = np.where(rows.live, 1 / np.where(rows.live, rows.scale, 1), 0).astype(np.float32)

        def place(part):
            shift, index = part
            known = rows.I[index] * inverse[index, None]
            box = self.box(shift)
            for i, values in zip(index, known.reshape(-1, rows.h, rows.w)):
                A[i][box[1:]] = values
            return shift, known.sum(0, dtype=float), rows.M[index][rows.live[index]].sum(0)

        total, count = np.zeros((self.H, self.W)), np.zeros((self.H, self.W))
        for shift, values, measured in parallel(place, self.parts(256)):
            total[self.box(shift)] += values.reshape(rows.h, rows.w)
            count[self.box(shift)] += measured.reshape(rows.h, rows.w)
        assert count.all(), "a sample that no row measured: extend the mean profile first"
        return A.reshape(rows.n, -1), (total / count).ravel()

    def fill(self, A, F, ridge):
        """Replaces what rows did not measure by F, fitted to what they did."""
        rows, inside = self.rows, np.zeros((self.H, self.W), bool)

        def complete(part):
            shift, index = part
            index = index[rows.live[index]]
            inside = np.zeros((self.H, self.W), bool)
            inside[self.box(shift)] = True
            inside = inside.ravel()
            whole = rows.whole or rows.M[index].all(1)
            same = index if rows.whole else index[whole]
            if not inside.all() and len(same):
                G = F * inside
                c = np.linalg.solve((G @ G.T + np.diag(ridge)), (A[same] @ G.T.astype(np.float32)).T.astype(float))
                outside = np.flatnonzero(~inside)
                A[np.ix_(same, outside)] = (c.T @ F[:, outside]).astype(np.float32)
            for i in [] if rows.whole else index[~whole]:
                K = np.zeros((self.H, self.W), bool)
                K[self.box(shift)] = rows.M[i].reshape(rows.h, rows.w)
                K = K.ravel()
                G = F[:, K]
                c = np.linalg.solve(G @ G.T + np.diag(ridge), G @ A[i, K])
                A[i, ~K] = (c @ F[:, ~K]).astype(np.float32)

        parallel(complete, self.parts(256))
        return not (rows.whole and inside.size == rows.h * rows.w)


def low_rank(A, terms, backend):
    """U s and Vt of the truncated SVD."""
    if backend == "randomized":
        from sklearn.utils.extmath import randomized_svd

        # scikit-learn's own choice for few terms. With 2 in the rounds that fill gaps, gaps are filled by a subspace
        # that has not converged, and rel_rmse is a tenth worse whatever the last round does.
        U, s, Vt = randomized_svd(A, terms, n_oversamples=10, n_iter=7, random_state=0)
    elif backend == "svds":
        from scipy.sparse.linalg import svds

        U, s, Vt = svds(A, terms, random_state=0)
        U, s, Vt = U[:, ::-1], s[::-1], Vt[::-1]
    elif backend == "gram":
        from scipy.sparse.linalg import eigsh

        values, vectors = eigsh((A.T @ A).astype(float), terms, v0=A[: len(A)].mean(0).astype(float))
        Vt = np.ascontiguousarray(vectors.T[::-1]).astype(A.dtype)
        s = np.sqrt(np.maximum(values[::-1], 0))
        return A @ Vt.T, s, Vt
    else:
        U, s, Vt = np.linalg.svd(A.astype(float), full_matrices=False)
        U, s, Vt = U[:, :terms].astype(A.dtype), s[:terms], Vt[:terms].astype(A.dtype)
    return U * s.astype(A.dtype), s, np.ascontiguousarray(Vt)


def legendre(u, degree):
    """[rows, P+1, samples]"""
    B = np.empty((len(u), degree + 1, u.shape[1]), u.dtype)
    B[:, 0] = 1
    if degree:
        B[:, 1] = u
    for p in range(1, degree):
        np.multiply(u, B[:, p], out=B[:, p + 1])
        B[:, p + 1] *= (2 * p + 1) / (p + 1)
        B[:, p + 1] -= p / (p + 1) * B[:, p - 1]
    return B


def solve(B, y, M, method):
    """Coefficients [rows, P+1, 3]; M is None when every sample was measured."""
    if M is not None:
        B, y = B * M[:, None], y * M[..., None]
    if method == "lstsq":
        return np.stack([np.linalg.lstsq(b.T, v, rcond=None)[0] for b, v in zip(B, y)])
    if method == "qr":
        Q, R = np.linalg.qr(B.transpose(0, 2, 1))
        return np.linalg.solve(R, Q.transpose(0, 2, 1) @ y)
    G = B @ B.transpose(0, 2, 1)
    # Rows that cannot tell the degrees apart keep a solution.
    G += 1e-14 * np.einsum("rpp->r", G)[:, None, None] * np.eye(G.shape[1])
    return np.linalg.solve(G, B @ y)


def colour(window, Us, Vt, degree, method):
    rows = window.rows
    cropped = {tuple(s): window.crop(Vt, s) for s, _ in window.groups}

    def bounds(part):
        shift, index = part
        E = Us[index] @ cropped[tuple(shift)]
        if not rows.whole:
            E = E[rows.M[index]]
        return (E.min(initial=np.inf), E.max(initial=-np.inf))

    with threadpool_limits(1):
        ranges = np.array(parallel(bounds, window.parts(64)))
    low, high = float(ranges[:, 0].min()), float(ranges[:, 1].max())
    beta = shared((rows.n, degree + 1, 3))

    def fit(part):
        shift, index = part
        error = size = 0.0
        for k in range(0, len(index), BLOCK):
            i = index[k : k + BLOCK]
            E = (Us[i] @ cropped[tuple(shift)]).astype(float)
            B = legendre((2 * E - low - high) / (high - low), degree)
            y = rows.R[i].astype(float)
            M = None if rows.whole else rows.M[i]
            beta[i] = c = solve(B, y, M, method).astype(np.float32)
            # What rounding leaves, too: of the coefficients as saved.
            y -= B.transpose(0, 2, 1) @ c.astype(float)
            if M is not None:
                y *= M[..., None]
            error += np.einsum("rsc,rsc->", y, y)
            y = rows.R[i]
            size += float(np.vdot(y, y))
        return error, size, float(rows.R[index].max())

    with threadpool_limits(1):
        sums = np.array(parallel(fit, window.parts(64 * BLOCK), processes=method == "lstsq"))
    return beta, (low, high), sums[:, 0].sum(), sums[:, 1].sum(), sums[:, 2].max()


def main(backend, method, path, out, terms, degree):
    clock = Clock()
    with threadpool_limits(1):
        rows = Rows(path)
        clock.stage("read")
        window = Window(rows)
        A, mean = window.normalized()
    del rows.I
    clock.stage("normalize")
    rounds = 0 if rows.whole and not rows.shift.any() else 2
    F, ridge = mean[None], np.zeros(1)
    for r in range(rounds + 1):
        if rounds:
            with threadpool_limits(1):
                window.fill(A, F, ridge)
            clock.stage("fill")
        with threadpool_limits(CORES):
            Us, s, Vt = low_rank(A, terms, backend)
        F, ridge = Vt.astype(float), rows.noise_level / (s.astype(float) ** 2 / rows.n)
        clock.stage("svd")
    del A
    beta, bounds, error, size, peak = colour(window, Us, Vt, degree, method)
    clock.stage("colour")
    np.savez(out, weights=s, incident=Us / s, offset=Vt, color=beta, shift=rows.shift.astype(np.int16), intensity_range=bounds)
    clock.stage("save")
    entries = rows.R.size if rows.whole else 3 * int(rows.M.sum())
    clock.report(
        f"tucker {backend} {method}",
        rel_rmse=float(np.sqrt(error / size)),
        psnr_db=psnr_db(peak, error, entries),
        bytes_f32=4 * (s.size + Us.size + Vt.size + beta.size + (rows.shift.size if rows.shift.any() else 0) + 2),
    )


if __name__ == "__main__":
    main(*sys.argv[1:5], int(sys.argv[5]), int(sys.argv[6]))
