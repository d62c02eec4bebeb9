#!/usr/bin/env python3
"""Kills, full disks and damaged bytes: what is left and what is noticed (docs/reliability.md).

scripts/reliability.py kills [N]        SIGKILL at random moments of commands that replace an output; then the old or the new one must be there, whole
scripts/reliability.py full-disk        the same commands on a tmpfs of growing size (needs root); nothing may look whole that is not
scripts/reliability.py resume           kills at a third, half and five sixths of a longer run, then the same command again: times of both over an undisturbed one's
scripts/reliability.py refusals         inputs that claim more than they hold, devices, bombs: exit status, time, memory
scripts/reliability.py large [N]        a capture of N photographs (default 10000), and one of 24 Mpx: time and memory of simulate, check, build-matrix
scripts/reliability.py damage [N]       one changed bit in a random place of each kind of file; counts what the reader says

ACQUIRE is the program (default target/release/acquire). Everything happens in a temporary folder.
"""
import hashlib, os, pathlib, random, shutil, signal, struct, subprocess, sys, tempfile, time, zlib

ACQUIRE = os.environ.get("ACQUIRE") or str(pathlib.Path(__file__).resolve().parent.parent / "target/release/acquire")
SMALL = "--grid 6x5 --window 11x9 --exposures 2 --voxels-per-sample 1".split()


def run(*args, cwd, ok=True):
    done = subprocess.run([ACQUIRE, *args, "--quiet"], cwd=cwd, capture_output=True, text=True)
    if ok and done.returncode:
        sys.exit(f"{args}: {done.stderr}")
    return done


def commands():
    """Name, arguments, output, and a command that reads the output."""
    return [
        ("simulate", ["simulate", "out", *SMALL, "--force"], "out", ["check", "out"]),
        ("build-matrix", ["build-matrix", "c", "--out", "out.rd.zarr", "--force"], "out.rd.zarr", ["evaluate", "out.rd.zarr", "m.rd.zarr"]),
        ("factor", ["factor", "m.rd.zarr", "--out", "out.safetensors", "--force"], "out.safetensors", ["evaluate", "out.safetensors", "m.rd.zarr"]),
        ("export", ["export", "m.safetensors", "--to", "npz", "--out", "out.npz", "--force"], "out.npz", None),
        ("relight", ["relight", "m.safetensors", "--light", "spot", "--out", "out.exr", "--force"], "out.exr", None),
        ("run", ["run", "c", "--out", "out", "--force"], "out", ["evaluate", "out/material.safetensors", "out/matrix.rd.zarr"]),
    ]


def inputs(folder):
    run("simulate", "c", *SMALL, cwd=folder)
    run("build-matrix", "c", "--out", "m.rd.zarr", cwd=folder)
    run("factor", "m.rd.zarr", "--out", "m.safetensors", cwd=folder)


def left(folder):
    return [p for p in pathlib.Path(folder).iterdir() if p.name.startswith(".acquire-")]


def kills(count):
    random.seed(1)
    with tempfile.TemporaryDirectory() as base:
        inputs(base)
        for name, command, output, reader in commands():
            lost = unread = leftovers = ended = 0
            run(*command, cwd=base)
            start = time.time()
            run(*command, cwd=base)
            secs = time.time() - start
            for _ in range(count):
                child = subprocess.Popen([ACQUIRE, *command, "--quiet"], cwd=base, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
                time.sleep(random.uniform(0, 1.1 * secs))
                ended += child.poll() is not None
                child.send_signal(signal.SIGKILL)
                child.wait()
                leftovers += bool(left(base))
                if not os.path.exists(os.path.join(base, output)):
                    lost += 1
                elif reader and run(*reader, cwd=base, ok=False).returncode:
                    unread += 1
            run(*command, cwd=base)
            print(f"{name}: {count} kills ({ended} after the end), output lost {lost}, not readable {unread}, leftovers after {leftovers} of them, after the next run {len(left(base))}", flush=True)
            target = pathlib.Path(base, output)
            shutil.rmtree(target) if target.is_dir() else target.unlink()


def full_disk():
    with tempfile.TemporaryDirectory() as base:
        inputs(base)
        for name, command, output, reader in commands():
            disk = os.path.join(base, "disk")
            fits = bad = points = hints = 0
            for kib in [16, 64, 128, 256, 512, 768, 1024, 1536, 2048, 3072, 4096, 8192, 16384, 32768]:
                os.makedirs(disk, exist_ok=True)
                subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", disk], check=True)
                try:
                    args = [a.replace("out", "disk/out", 1) if a.startswith("out") else a for a in command]
                    done = run(*args, cwd=base, ok=False)
                    points += 1
                    whole = os.path.exists(os.path.join(disk, output))
                    if done.returncode == 0:
                        fits += 1
                    else:
                        hints += "the disk is full" in done.stderr
                        bad += whole or done.returncode != 1 or bool(left(disk)) != ("kept: " in done.stderr)
                finally:
                    subprocess.run(["umount", disk], check=True)
            print(f"{name}: {points} sizes, {fits} large enough, {hints} refused as a full disk, {bad} left something or ended otherwise", flush=True)


def digest(path):
    """All files of an output that do not hold times."""
    files = sorted(p for p in pathlib.Path(path).rglob("*") if p.is_file() and p.suffix not in (".html", ".csv", ".json", ".svg") or p.name == "zarr.json")
    return hashlib.sha256(b"".join(p.read_bytes() for p in files)).hexdigest()


def resume():
    long = "--material chessboard-4x4 --grid 26x22 --window 25x21 --lit-pitch-mm 1.5".split()
    with tempfile.TemporaryDirectory() as base:
        run("simulate", "c", *long, "--seed", "1", cwd=base)
        run("build-matrix", "c", "--out", "m.rd.zarr", cwd=base)
        for name, command, output in [
            ("build-matrix", ["build-matrix", "c", "--out", "out.rd.zarr"], "out.rd.zarr"),
            ("simulate", ["simulate", "out", *long, "--seed", "2"], "out"),
            ("run", ["run", "c", "--out", "out"], "out"),
            ("tradeoff", ["tradeoff", "m.rd.zarr", "--quick", "--out", "out"], "out"),
        ]:
            undisturbed = []
            for _ in range(3):
                shutil.rmtree(os.path.join(base, output), ignore_errors=True)
                start = time.time()
                run(*command, cwd=base)
                undisturbed.append(time.time() - start)
            whole, same = digest(os.path.join(base, output)), digest(os.path.join(base, output, "matrix.rd.zarr"))
            secs = sorted(undisturbed)[1]
            print(f"{name}: undisturbed {secs:.2f} s;", end="", flush=True)
            for share in (1 / 3, 1 / 2, 5 / 6):
                shutil.rmtree(os.path.join(base, output), ignore_errors=True)
                child = subprocess.Popen([ACQUIRE, *command, "--quiet"], cwd=base, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
                time.sleep(share * secs)
                if child.poll() is not None:
                    print(f" ended before {share:.0%};", end="")
                    continue
                child.send_signal(signal.SIGKILL)
                child.wait()
                start = time.time()
                done = subprocess.run([ACQUIRE, *command], cwd=base, capture_output=True, text=True, check=True)
                again = time.time() - start
                taken = [line for line in done.stderr.splitlines() if "stopped run" in line and "taken" in line]
                equal = digest(os.path.join(base, output)) == whole or digest(os.path.join(base, output, "matrix.rd.zarr")) == same
                print(f" killed at {share:.0%}: {again:.2f} s more, {(share * secs + again) / secs:.2f} in all ({'; '.join(taken) or 'nothing taken over'}; {'same bytes' if equal else 'OTHER BYTES'})", end="", flush=True)
            print(flush=True)


def damage(count):
    random.seed(1)
    with tempfile.TemporaryDirectory() as base:
        inputs(base)
        run("simulate", "t", *SMALL, "--format", "tiff", cwd=base)
        run("simulate", "j", *SMALL, "--format", "jpeg", cwd=base)
        run("factor", "m.rd.zarr", "--out", "m.acq", cwd=base)
        kinds = [
            ("matrix, rows", "m.rd.zarr/{response,variance,valid}/c.*", ["evaluate", "m.safetensors", "m.rd.zarr"]),
            ("matrix, coordinates", "m.rd.zarr/*/c/**/*", ["evaluate", "m.safetensors", "m.rd.zarr"]),
            ("matrix, metadata", "m.rd.zarr/**/zarr.json", ["evaluate", "m.safetensors", "m.rd.zarr"]),
            ("material, plain", "m.safetensors", ["evaluate", "m.safetensors", "m.rd.zarr"]),
            ("material, coded", "m.acq", ["evaluate", "m.acq", "m.rd.zarr"]),
            ("photograph, PNG", "c/photos/*", ["build-matrix", "c", "--out", "x.rd.zarr", "--force"]),
            ("photograph, TIFF", "t/photos/*", ["build-matrix", "t", "--out", "x.rd.zarr", "--force"]),
            ("photograph, JPEG", "j/photos/*", ["build-matrix", "j", "--out", "x.rd.zarr", "--force"]),
        ]
        for name, pattern, reader in kinds:
            files = []
            for one in ([pattern.replace("{response,variance,valid}", a) for a in ("response", "variance", "valid")] if "{" in pattern else [pattern]):
                files += [p for p in pathlib.Path(base).glob(one) if p.is_file()]
            before = run(*reader, cwd=base).stdout
            refused = same = silent = other = named = 0
            for _ in range(count):
                path = random.choice(sorted(files))
                bytes_ = bytearray(path.read_bytes())
                kept = bytes(bytes_)
                at = random.randrange(len(bytes_))
                bytes_[at] ^= 1 << random.randrange(8)
                path.write_bytes(bytes_)
                done = run(*reader, cwd=base, ok=False)
                if done.returncode == 1:
                    refused += 1
                    named += path.name in done.stderr
                elif done.returncode:
                    other += 1
                elif done.stdout == before and "matrix" in name:
                    same += 1
                else:
                    silent += 1
                path.write_bytes(kept)
            print(f"{name}: {count} bits, refused {refused} ({named} by the file's name), read with the same result {same}, otherwise {silent}, ended otherwise {other}", flush=True)


def measured(*args, cwd):
    """Exit status, first line of what it says, seconds, MB of the largest resident memory."""
    start = time.time()
    with tempfile.TemporaryFile("w+") as said:
        child = subprocess.Popen([ACQUIRE, *args], cwd=cwd, stdout=subprocess.DEVNULL, stderr=said)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        lines = [line for line in said.read().splitlines() if line.startswith("error")] or [""]
    return child.returncode, lines[0], time.time() - start, usage.ru_maxrss / 1024


def png(width, height, depth, kind, chunks=()):
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    line = 1 + (width * depth * {0: 1, 2: 3}[kind] + 7) // 8
    packer = zlib.compressobj(9)
    body = b"".join(packer.compress(bytes(line)) for _ in range(height)) + packer.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunk(*c) for c in chunks) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def refusals():
    corpus = pathlib.Path(__file__).resolve().parent.parent / "fuzz/corpus"
    with tempfile.TemporaryDirectory() as base:
        inputs(base)
        bombs = pathlib.Path(base, "bombs")
        bombs.mkdir()
        (bombs / "gray-11k.png").write_bytes(png(11000, 11000, 8, 0))
        (bombs / "rgb-100Mpx.png").write_bytes(png(10000, 10000, 8, 2))
        (bombs / "rgb-4Gpx.png").write_bytes(png(65000, 65000, 8, 2)[:200_000])
        bomb = b"icc\0\0" + zlib.compress(bytes(1 << 30), 9)
        (bombs / "iccp-1GiB.png").write_bytes(png(40, 30, 8, 2, [(b"iCCP", bomb)]))
        (bombs / "empty.png").write_bytes(b"")
        # One strip that claims 40000 × 40000 px of 16 bits.
        fields = [(256, 4, 40000), (257, 4, 40000), (258, 3, 16), (259, 3, 1), (262, 3, 1), (273, 4, 8), (277, 3, 1), (278, 4, 40000), (279, 4, 4)]
        entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in fields)
        (bombs / "declared-40k.tif").write_bytes(b"II*\0" + struct.pack("<I", 12) + bytes(4) + struct.pack("<H", len(fields)) + entries + bytes(4))
        os.mkfifo(bombs / "fifo.png")
        os.symlink("/dev/zero", bombs / "device.png")
        (bombs / "folder.png").mkdir()
        manifest = pathlib.Path(base, "c/capture.toml")
        whole = manifest.read_text()
        first = next(line for line in whole.splitlines() if line.startswith("file = "))
        rows = []
        for path in sorted((corpus / "photograph").iterdir()) + sorted(bombs.iterdir()):
            manifest.write_text(whole.replace(first, f'file = "{path}"', 1))
            rows.append((f"photograph {path.name}", measured("build-matrix", "c", "--out", "x.rd.zarr", "--force", "-q", cwd=base)))
        manifest.write_text(whole)
        for path in sorted((corpus / "light").iterdir()) + sorted(bombs.iterdir()):
            rows.append((f"light {path.name}", measured("relight", "m.safetensors", "--light", str(path), "--out", "x.exr", "--force", "-q", cwd=base)))
        for path in sorted(bombs.iterdir()):
            rows.append((f"material {path.name}", measured("evaluate", str(path), "m.rd.zarr", cwd=base)))
            rows.append((f"matrix {path.name}", measured("factor", str(path), "--out", "y.safetensors", "--force", "-q", cwd=base)))
        for path in sorted((corpus / "matrix").iterdir()):
            shutil.copytree(os.path.join(base, "m.rd.zarr"), os.path.join(base, "bad.rd.zarr"), dirs_exist_ok=True)
            shutil.copy(path, os.path.join(base, "bad.rd.zarr/response/zarr.json"))
            rows.append((f"matrix {path.name}", measured("factor", "bad.rd.zarr", "--out", "y.safetensors", "--force", "-q", cwd=base)))
        for name, (status, line, secs, mb) in rows:
            print(f"| {name} | {status} | {secs:.2f} s | {mb:.0f} MB | {line[:110]} |", flush=True)
        worst = [max(r[1][k] for r in rows if r[1][0] == 1) for k in (2, 3)]
        others = [r[0] for r in rows if r[1][0] not in (0, 1)]
        print(f"{len(rows)} inputs, {sum(r[1][0] == 1 for r in rows)} refused, the slowest in {worst[0]:.2f} s, the largest with {worst[1]:.0f} MB; ended otherwise: {others or 'none'}")


def large(count):
    side = max(2, round((count / 3) ** 0.5))
    whole_way("many photographs", "--grid", f"{side}x{side}", "--window", "9x9", "--lit-pitch-mm", "0.5", "--spacing", f"{side}x{side}")
    whole_way("24 Mpx", "--grid", "2x2", "--window", "31x25", "--camera-size", "6000x4000")


def whole_way(name, *options):
    """Time and memory of simulate with these options, of check and build-matrix; the capture's size."""
    with tempfile.TemporaryDirectory() as base:
        for command, args in [
            ("simulate", ["c", *options, "--exposures", "3", "--voxels-per-sample", "1"]),
            ("check", ["c"]),
            ("build-matrix", ["c", "--out", "c.rd.zarr"]),
        ]:
            status, line, secs, mb = measured(command, *args, "-q", cwd=base)
            print(f"{name}: {command}: exit {status}, {secs:.1f} s, {mb:.0f} MB {line}", flush=True)
        photographs = list(pathlib.Path(base, "c/photos").iterdir())
        print(f"{name}: {len(photographs)} photographs, {sum(p.stat().st_size for p in photographs) / 1e6:.0f} MB", flush=True)


if __name__ == "__main__":
    what = sys.argv[1] if len(sys.argv) > 1 else ""
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 40
    if what == "kills":
        kills(count)
    elif what == "full-disk":
        full_disk()
    elif what == "resume":
        resume()
    elif what == "refusals":
        refusals()
    elif what == "large":
        large(int(sys.argv[2]) if len(sys.argv) > 2 else 10_000)
    elif what == "damage":
        damage(count)
    else:
        sys.exit(__doc__)
