"""What all pipelines share: the store, the parallel loop, the measures and the line that is printed."""

import json
import mmap
import multiprocessing
import os
import resource
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import zarr

CORES = len(os.sched_getaffinity(0))
work = None  # what a forked process is to run


def shared(shape, dtype=np.float32):
    """An array that forked processes write to as well."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = mmap.mmap(-1, max(size, 1))
    memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, dtype, int(np.prod(shape))).reshape(shape)


def _run(item):
    return work(item)


def parallel(function, items, processes=False):
    """function of every item, on all cores: in threads where NumPy gives up the interpreter's lock, else in processes."""
    global work
    if not processes:
        with ThreadPoolExecutor(CORES) as pool:
            return list(pool.map(function, items))
    work = function
    with multiprocessing.get_context("fork").Pool(CORES) as pool:
        return pool.map(_run, items, chunksize=1)


class Clock:
    """Wall and processor time, and peak memory, of this process and those that it starts."""

    def __init__(self):
        self.wall, self.cpu = time.perf_counter(), self.used()
        self.peak, self.done, self.stages = 0, False, {}
        self.last = self.wall
        threading.Thread(target=self.sample, daemon=True).start()

    @staticmethod
    def used():
        both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(r.ru_utime + r.ru_stime for r in both)

    def sample(self):
        # Shared pages once: the sum of the proportional sizes. getrusage counts them for every process.
        while not self.done:
            pids = [os.getpid()] + [p.pid for p in multiprocessing.active_children()]
            total = 0
            for pid in pids if len(pids) > 1 else []:
                try:
                    with open(f"/proc/{pid}/smaps_rollup") as lines:
                        total += next(int(l.split()[1]) for l in lines if l.startswith("Pss:"))
                except (OSError, StopIteration):
                    pass
            self.peak = max(self.peak, total)
            time.sleep(0.5)

    def stage(self, name):
        now = time.perf_counter()
        self.stages[name] = round(self.stages.get(name, 0) + now - self.last, 2)
        self.last = now

    def report(self, pipeline, **more):
        self.done = True
        peak = max(self.peak, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        line = {
            "pipeline": pipeline,
            "secs": round(time.perf_counter() - self.wall, 2),
            "cpu_secs": round(self.used() - self.cpu, 2),
            "peak_mib": round(peak / 1024),
        }
        print(json.dumps(line | more | {"stages": self.stages}), flush=True)


def psnr_db(peak, error, entries):
    return round(20 * np.log10(peak / np.sqrt(error / entries)), 3) if error > 0 else None


def blocks(array):
    """Ranges of rows, chunk by chunk: (y, first x, last x)."""
    ny, nx = array.shape[:2]
    step = array.chunks[1]
    return [(y, x, min(x + step, nx)) for y in range(ny) for x in range(0, nx, step)]


def read(path):
    """Responses [rows, dy, dx, channel] as float32, without gaps in them, and the grid; for the models without a shift."""
    store = zarr.open_group(path, mode="r")
    source, valid = store["response"], store["valid"]
    ny, nx, h, w, c = source.shape
    R = shared((ny * nx, h, w, c))

    def load(block):
        y, a, b = block
        R[y * nx + a : y * nx + b] = source[y, a:b]
        return bool((valid[y, a:b] != 0).all())

    if not all(parallel(load, blocks(source))):
        raise SystemExit("samples that were not measured: this pipeline has no weights")
    return R
