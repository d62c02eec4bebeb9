"""Programs of two revisions, built alike, for compare.py. Python 3.11, standard library; needs git, cargo and what the build needs.

Both are built in the same folder, one after the other, by the same cargo with CARGO_INCREMENTAL=0: neither the path nor the
division into code-generation units differs. The dependencies are shared. A program is kept under the hash of what it is made
of (src, Cargo.toml, Cargo.lock, the compiler), so that a revision that changes only documents is not built again.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

MADE_OF = ["src", "Cargo.toml", "Cargo.lock"]
WORKING_TREE = "the working tree"


def say(text):
    print(text, file=sys.stderr, flush=True)


def git(root, *arguments, env=None):
    """Output of a git command, without the final newline; stops the program when it fails."""
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, env=env)
    if done.returncode:
        sys.exit(f"error: git {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout.strip()


def tree_of(root, revision):
    """The git tree of a revision; of the working tree (None) as it lies there, new files too, ignored ones not."""
    if revision is not None:
        return git(root, "rev-parse", "--verify", f"{revision}^{{tree}}")
    with tempfile.TemporaryDirectory() as folder:
        # An index of its own: what the person has staged stays as it is.
        env = {**os.environ, "GIT_INDEX_FILE": f"{folder}/index"}
        git(root, "read-tree", "HEAD", env=env)
        git(root, "add", "--all", ".", env=env)
        return git(root, "write-tree", env=env)


def name_of(root, revision):
    """How a table calls it."""
    if revision is not None:
        return f"{revision} ({git(root, 'rev-parse', '--short', revision + '^{commit}')})"
    changed = git(root, "status", "--porcelain")
    return f"{WORKING_TREE} ({git(root, 'rev-parse', '--short', 'HEAD')}{' and changes' if changed else ''})"


def key_of(root, tree):
    """What a program is made of: equal keys, equal programs."""
    parts = [git(root, "rev-parse", f"{tree}:{part}") for part in MADE_OF]
    parts.append(subprocess.run(["cargo", "--version"], capture_output=True, text=True, check=True).stdout)
    parts.append(os.environ.get("RUSTFLAGS", ""))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def seed(root, cargo):
    """Takes the dependencies over that the checkout's own build has made: OpenCV's bindings alone take minutes. Cargo
    looks at each and builds anew what does not fit."""
    built = Path(os.environ.get("CARGO_TARGET_DIR", root / "target")) / "release"
    if cargo.exists() or not built.is_dir():
        return
    say("compare: copying built dependencies")
    for part in [".fingerprint", "build", "deps"]:
        def ours(folder, names):
            return [n for n in names if n.startswith(("acquire-", "libacquire-"))]

        if (built / part).is_dir():
            # copytree keeps times, by which cargo knows what is fresh.
            shutil.copytree(built / part, cargo / "release" / part, symlinks=True, ignore=ours)


def program(root, cache, revision):
    """Path of the program of a revision (None: the working tree), built when it is not there yet."""
    tree = tree_of(root, revision)
    key = key_of(root, tree)
    kept = cache / "programs" / key / "acquire"
    if kept.is_file():
        return kept
    cargo, source = cache / "cargo", cache / "source"
    seed(root, cargo)
    shutil.rmtree(source, ignore_errors=True)
    source.mkdir(parents=True)
    # Files as the tree has them, with today's time: cargo then sees a changed package. No entry in `git worktree list`.
    archive = subprocess.Popen(["git", "-C", str(root), "archive", tree], stdout=subprocess.PIPE)
    subprocess.run(["tar", "-x", "-m", "-C", str(source)], stdin=archive.stdout, check=True)
    if archive.wait():
        sys.exit(f"error: git archive {tree} failed")
    say(f"compare: building {name_of(root, revision)}")
    env = {**os.environ, "CARGO_TARGET_DIR": str(cargo), "CARGO_INCREMENTAL": "0"}
    done = subprocess.run(["cargo", "build", "--release", "--locked", "--bin", "acquire"], cwd=source, env=env, stdout=sys.stderr)
    if done.returncode:
        sys.exit(f"error: {name_of(root, revision)} does not build")
    kept.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(cargo / "release" / "acquire", str(kept) + ".part")
    os.rename(str(kept) + ".part", kept)
    return kept
