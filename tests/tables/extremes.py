"""Writes the tables beside it, with mpmath: python extremes.py

singular.json    singular values of small matrices as rows come (`plain`) and divided by their largest entry
                 (`normalized`, as `tucker` factors them; a row without a positive entry is zeros). 160 digits inside,
                 20 outside: rows from 1e-30 to 1e30 need twice their 60 decades.
polynomials.json least-squares polynomials of a row's three channels in its intensity, (R + G + B) / 3 exactly, mapped to
                 [-1, 1] from its smallest to its largest: what no solver in f64 can beat. Samples lie on the eighth
                 0 <= dy <= dx <= 15 of a 31 x 31 window and count as often as the window has them.
Entries are numbers that are exact in f32; results are strings of 20 digits.
"""

import json
from pathlib import Path

import mpmath as mp
import numpy as np

HERE = Path(__file__).parent
ROWS, COLUMNS = 8, 9


def exact(values):
    """To f32 and back: what a matrix on disk holds. The shortest decimals that give the same f32, as f64."""
    return [float(v) for v in np.asarray(values, np.float32).ravel()]


def singular_values(rows):
    values = mp.svd_r(mp.matrix(rows), compute_uv=False)
    return [mp.nstr(v, 20) for v in sorted(values, reverse=True)]


def spectrum(values):
    """Rows with these singular values (before rounding to f32) and cosines for vectors."""
    cosines = lambda n: np.array([[np.cos(np.pi * (i + 0.5) * k / n) * np.sqrt((2 - (k == 0)) / n) for k in range(n)] for i in range(n)])
    return (cosines(ROWS) * values) @ cosines(COLUMNS)[:, :ROWS].T


def singular():
    k = np.arange(ROWS)
    wave = np.array([[0.4 * (1.5 + np.sin(1 + 2 * i + j * (i + 1) / 3)) for j in range(COLUMNS)] for i in range(ROWS)])
    scales = 10.0 ** np.array([-30, -21, -12, -4, 4, 13, 22, 30])
    cases = {
        "rows from 1e-30 to 1e30": wave * scales[:, None],
        "subnormal rows": np.round(wave * 100) * 2.0**-149 * (1 + 50 * k[:, None]),
        "repeated rows": wave[[0, 1, 2, 0, 1, 2, 0, 1]],
        "fast decay": spectrum(10.0**-k),
        "slow decay": spectrum(1 / (1 + k)),
        "no decay": spectrum(np.ones(ROWS)),
        "one non-zero entry": np.where(np.arange(ROWS * COLUMNS) == 30, 0.7, 0).reshape(ROWS, COLUMNS),
    }
    out = []
    for name, matrix in cases.items():
        entries = exact(matrix)
        rows = [[mp.mpf(v) for v in entries[i * COLUMNS : (i + 1) * COLUMNS]] for i in range(ROWS)]
        scaled = [[v / max(row) if max(row) > 0 else mp.mpf(0) for v in row] for row in rows]
        out.append({"name": name, "entries": entries, "plain": singular_values(rows), "normalized": singular_values(scaled)})
    return {"rows": ROWS, "columns": COLUMNS, "cases": out}


def legendre(u, degree):
    values = [mp.mpf(1), u]
    for p in range(1, degree):
        values.append(((2 * p + 1) * u * values[p] - p * values[p - 1]) / (p + 1))
    return values[: degree + 1]


def condition(columns, weights):
    design = mp.matrix([[mp.sqrt(w) * v for v in row] for row, w in zip(columns, weights)])
    values = mp.svd_r(design, compute_uv=False)
    return mp.nstr(max(values) / min(values), 6)


def polynomials():
    samples = [(dx, dy) for dy in range(16) for dx in range(dy, 16)]
    count = [(1 if dx == 0 else 2) * (1 if dy == 0 else 2) * (1 if dx == dy else 2) for dx, dy in samples]
    r = np.hypot(*np.array(samples, float).T)
    rgb = np.stack([1.1 * np.exp(-r / 2.2), np.exp(-r / 2), 0.8 * np.exp(-r / 1.8) + 0.05 / (1 + r) ** 3], 1)
    rgb = np.array(exact(rgb)).reshape(-1, 3)
    intensity = [sum(mp.mpf(float(v)) for v in row) / 3 for row in rgb]
    low, high = min(intensity), max(intensity)
    u = [(2 * i - low - high) / (high - low) for i in intensity]
    out = []
    for degree in (1, 7, 15):
        B = mp.matrix([legendre(v, degree) for v in u])
        W = mp.diag([mp.mpf(c) for c in count])
        gram = B.T * W * B
        fit = [B * mp.cholesky_solve(gram, B.T * W * mp.matrix([mp.mpf(float(v)) for v in rgb[:, c]])) for c in range(3)]
        residual = [mp.sqrt(mp.fsum(n * (f - mp.mpf(float(v))) ** 2 for n, f, v in zip(count, fit[c], rgb[:, c]))) for c in range(3)]
        conditions = {
            "legendre": condition([legendre(v, degree) for v in u], count),
            "monomial": condition([[i**p for p in range(degree + 1)] for i in (i / high for i in intensity)], count),
        }
        print(f"degree {degree}: condition number {conditions}")
        fitted = [[mp.nstr(f[k], 20) for f in fit] for k in range(len(samples))]
        out.append({"degree": degree, "condition": conditions, "residual_norm": [mp.nstr(v, 20) for v in residual], "fitted": fitted})
    rows = [{"offset": list(o), "count": n, "rgb": list(map(float, v))} for o, n, v in zip(samples, count, rgb)]
    return {"window": [31, 31], "samples": rows, "fits": out}


mp.mp.dps = 160
(HERE / "singular.json").write_text(json.dumps(singular(), indent=None, separators=(",", ":")) + "\n")
mp.mp.dps = 100
(HERE / "polynomials.json").write_text(json.dumps(polynomials(), separators=(",", ":")) + "\n")
