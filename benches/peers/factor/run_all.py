"""Runs the pipelines one after another, each in a process of its own, and prints a table. See run.sh."""

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

TUCKER = [("randomized", "normal"), ("randomized", "qr"), ("randomized", "lstsq"), ("svds", "normal"), ("gram", "normal"), ("full", "qr")]
OTHERS = ["joint", "nmf-mu", "nmf-cd", "tensorly-tucker", "tensorly-parafac"]
# Entries of the matrix above which a pipeline would take longer than an hour or more than 16 GiB here.
LARGEST = {"full": 3e7, "nmf-mu": 1e8, "nmf-cd": 1e8, "tensorly-tucker": 1e8, "tensorly-parafac": 3e7, "svds": 1e9}
SECS = 1800
# Large arrays from the heap, whose pages are kept: a fifth of the time of most pipelines.
KEEP = "glibc.malloc.mmap_threshold=4294967296:glibc.malloc.trim_threshold=8589934592:glibc.malloc.top_pad=268435456"


def plain_read(store):
    """Seconds and bytes of one sequential read of all files of the store, as warm as the system has them."""
    files = sorted(p for p in Path(store).rglob("*") if p.is_file())
    start, total = time.perf_counter(), 0
    buffer = bytearray(1 << 20)
    for path in files:
        with open(path, "rb", buffering=0) as file:
            while got := file.readinto(buffer):
                total += got
    return time.perf_counter() - start, total


def entries(store):
    count = 1
    for n in json.loads((Path(store) / "response" / "zarr.json").read_text())["shape"]:
        count *= n
    return count


def ours(acquire, store, out, terms, degree):
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([acquire, "factor", store, "--out", out, "--terms", str(terms), "--degree", str(degree), "-q"], check=True)
    secs, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    line = {"pipeline": "acquire factor", "secs": round(secs, 2), "cpu_secs": round(cpu, 2), "peak_mib": round(after.ru_maxrss / 1024)}
    measured = json.loads(subprocess.run([acquire, "evaluate", out, store, "--json"], check=True, capture_output=True).stdout)
    return line | {key: measured.get(key) for key in ("rel_rmse", "psnr_db", "bytes_f32")}


def main(store, work, terms, degree, *only):
    here, size = Path(__file__).parent, entries(store)
    plain_read(store)
    secs, total = plain_read(store)
    lines = [{"pipeline": "plain sequential read, warm", "secs": round(secs, 2), "bytes": total}]
    print(json.dumps(lines[0]), flush=True)
    acquire = os.environ.get("ACQUIRE")
    if acquire:  # first: the peak memory of a child is known only as the largest of all
        lines.append(ours(acquire, store, f"{work}/ours.safetensors", terms, degree))
        print(json.dumps(lines[-1]), flush=True)
    jobs = [(f"tucker {b} {c}", b, ["tucker.py", b, c]) for b, c in TUCKER] + [(p, p, ["others.py", p]) for p in OTHERS]
    for name, key, command in jobs:
        if only and name.replace(" ", "-") not in only:
            continue
        if not only and size > LARGEST.get(key, float("inf")):
            print(json.dumps({"pipeline": name, "left_out": f"{size:.3g} entries: hours, or more memory than there is"}), flush=True)
            continue
        command = [sys.executable, str(here / command[0]), *command[1:], store, f"{work}/out.npz", terms, degree]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=SECS, env=os.environ | {"GLIBC_TUNABLES": KEEP})
        except subprocess.TimeoutExpired:
            print(json.dumps({"pipeline": name, "left_out": f"longer than {SECS} s"}), flush=True)
            continue
        if done.returncode:
            print(json.dumps({"pipeline": name, "failed": done.stderr.strip().splitlines()[-1:]}), flush=True)
            continue
        lines.append(json.loads(done.stdout.splitlines()[-1]))
        print(json.dumps(lines[-1]), flush=True)
    print(f"\n{'pipeline':<28}{'s':>9}{'CPU s':>9}{'peak MiB':>10}{'rel_rmse':>11}{'PSNR dB':>9}{'bytes_f32':>13}")
    for line in lines:
        cells = [line.get(k) for k in ("secs", "cpu_secs", "peak_mib", "rel_rmse", "psnr_db", "bytes_f32")]
        text = [f"{c:>{w}{f}}" if c is not None else " " * w for c, w, f in zip(cells, (9, 9, 10, 11, 9, 13), (".2f", ".2f", "", ".6f", ".2f", ""))]
        print(f"{line['pipeline']:<28}" + "".join(text))


if __name__ == "__main__":
    main(*sys.argv[1:])
