"""Other factorizations by the usual libraries: python others.py PIPELINE STORE OUT.npz TERMS DEGREE

All of them get as many numbers as `tucker` with these TERMS and DEGREE stores, and rows as measured, without a shift.
nmf-mu, nmf-cd    peers2006 with scikit-learn: each channel a non-negative factorization. Dividing the mean profile out
                  and weighting with its square, as the published method may, is the same problem: the factors absorb it.
joint             truncated SVD of the rows of all channels together (scikit-learn's randomized SVD)
tensorly-tucker   rows x offsets x channels, higher-order orthogonal iteration; all three channel vectors kept
tensorly-parafac  the same tensor as a sum of outer products, alternating least squares
"""

import sys
import warnings

import numpy as np
from common import CORES, Clock, parallel, psnr_db, read
from threadpoolctl import threadpool_limits


def nmf(R, terms, solver):
    from sklearn.decomposition import NMF

    def channel(c):
        model = NMF(terms, solver=solver, init="nndsvda", max_iter=200, tol=1e-5, random_state=0)
        W = model.fit_transform(np.maximum(R[..., c], 0))
        return W, model.components_

    with threadpool_limits(1):
        planes = parallel(channel, range(3), processes=True)
    return [np.stack(p) for p in zip(*planes)], lambda rows: np.stack([W[rows] @ H for W, H in planes], -1)


def joint(R, terms):
    from sklearn.utils.extmath import randomized_svd

    U, s, Vt = randomized_svd(R.reshape(len(R), -1), terms, n_iter=7, random_state=0)
    return [U, s, Vt], lambda rows: ((U[rows] * s) @ Vt).reshape(-1, *R.shape[1:])


def tensorly_tucker(R, terms):
    from tensorly.decomposition import tucker

    core, factors = tucker(R, rank=terms, init="svd", svd="randomized_svd", n_iter_max=20, random_state=0)
    H = np.einsum("abc,eb,kc->aek", core, factors[1], factors[2]).reshape(core.shape[0], -1)
    return [core, *factors], lambda rows: (factors[0][rows] @ H).reshape(-1, *R.shape[1:])


def tensorly_parafac(R, terms):
    from tensorly.decomposition import parafac

    weights, (a, b, c) = parafac(R, rank=terms, init="svd", svd="randomized_svd", n_iter_max=100, random_state=0)
    H = (b[:, None] * c[None]).reshape(-1, len(weights)).T
    return [weights, a, b, c], lambda rows: ((a[rows] * weights) @ H).reshape(-1, *R.shape[1:])


def main(pipeline, path, out, terms, degree):
    warnings.simplefilter("ignore")  # of iterations that have not converged: they are as long as most would wait
    clock = Clock()
    R = read(path)
    clock.stage("read")
    n, e = len(R), R.shape[1] * R.shape[2]
    R = R.reshape(n, e, 3)
    budget = terms * (1 + n + e) + n * 3 * (degree + 1) + 2
    ranks = np.arange(1, min(n, 3 * e))
    if pipeline.startswith("nmf"):
        t = ranks[3 * ranks * (n + e + 1) + 3 * e <= budget].max()
        arrays, rows = nmf(R, t, pipeline[4:])
    elif pipeline == "joint":
        t = ranks[ranks * (n + 3 * e + 1) <= budget].max()
        arrays, rows = joint(R, t)
    elif pipeline == "tensorly-tucker":
        # As many offsets' vectors as rows' would be kept by joint at most times three: half more than rows' does best.
        best = ranks[ranks * n + np.minimum(e, 3 * ranks // 2) * (e + 3 * ranks) + 9 <= budget].max()
        t = (int(best), int(min(e, 3 * best // 2)), 3)
        arrays, rows = tensorly_tucker(R, t)
    else:
        t = ranks[ranks * (n + e + 4) <= budget].max()
        arrays, rows = tensorly_parafac(R, int(t))
    clock.stage("factor")

    def measure(k):
        k = slice(k, k + 256)
        return [np.square(rows(k) - R[k], dtype=float).sum(), np.square(R[k], dtype=float).sum(), R[k].max()]

    with threadpool_limits(1):
        sums = np.array(parallel(measure, range(0, n, 256)))
    clock.stage("measure")
    np.savez(out, *arrays)
    error, size = sums[:, :2].sum(0)
    clock.report(
        pipeline,
        rel_rmse=float(np.sqrt(error / size)),
        psnr_db=psnr_db(sums[:, 2].max(), error, R.size),
        bytes_f32=4 * sum(a.size for a in arrays),
        terms=t if isinstance(t, tuple) else int(t),
    )


if __name__ == "__main__":
    main(*sys.argv[1:4], int(sys.argv[4]), int(sys.argv[5]))
