#!/usr/bin/env bash
# Installs what the build needs besides Rust, gcc and make: OpenCV 4 and libclang (the opencv crate
# generates its bindings while it builds). Does nothing when everything is there.
# `setup.sh python`: what the Python module's tests need besides cargo and a compiler, which is Python with venv; with
# CI=true also an LLVM for Mitsuba.
set -euo pipefail

# The same names on Debian 12 and later and on Ubuntu 22.04 and later.
packages=(libopencv-dev clang g++ pkg-config)
[ "${1:-}" = python ] && packages=(python3 python3-venv)
what=${1:-}

missing() {
    if [ "$what" = python ]; then
        "${PYTHON:-python3}" -c 'import ensurepip, venv, sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || echo "Python 3.10 or later with venv"
        return
    fi
    command -v g++ >/dev/null || echo "g++"
    command -v pkg-config >/dev/null || { echo "pkg-config"; return; }
    pkg-config --exists opencv4 || echo "OpenCV 4 (opencv4.pc)"
    # Where the clang-sys crate looks first is LIBCLANG_PATH, then the places of the distributions.
    compgen -G "${LIBCLANG_PATH:-/nonexistent}/libclang*" >/dev/null \
        || compgen -G "/usr/lib/llvm*/lib/libclang*.so*" >/dev/null \
        || compgen -G "/usr/lib*/libclang*.so*" >/dev/null \
        || compgen -G "/usr/lib/*/libclang*.so*" >/dev/null \
        || compgen -G "/opt/homebrew/opt/llvm/lib/libclang*" >/dev/null \
        || compgen -G "/Library/Developer/CommandLineTools/usr/lib/libclang*" >/dev/null \
        || echo "libclang"
}

if ! command -v cargo >/dev/null; then
    echo "setup: cargo not found. Install Rust (https://rustup.rs) and try again." >&2
    exit 1
fi

# Mitsuba compiles with an LLVM that Debian 12 does not install by itself; without one its tests are skipped.
if [ "$what" = python ] && [ "${CI:-}" = true ] && [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
    apt-get install -y --no-install-recommends libllvm19 >/dev/null 2>&1 || echo "setup: no libllvm19: Mitsuba's tests are skipped" >&2
fi

lacking=$(missing)
[ -z "$lacking" ] && exit 0
echo "setup: missing: $(echo "$lacking" | paste -sd, | sed 's/,/, /g')" >&2

if ! command -v apt-get >/dev/null; then
    [ "$what" = python ] && { echo "setup: no apt-get on this system. Install Python 3.10 or later with venv, then try again." >&2; exit 1; }
    cat >&2 <<'TEXT'
setup: no apt-get on this system. Install these with its package manager, then try again:
  OpenCV 4 with development files   (Fedora: opencv-devel, Arch: opencv, Homebrew: opencv)
  Clang with libclang               (Fedora: clang-devel, Arch: clang, Homebrew: llvm)
  a C++ compiler and pkg-config     (Fedora: gcc-c++ pkgconf, Arch: base-devel, Homebrew: pkgconf)
TEXT
    exit 1
fi

sudo=""
if [ "$(id -u)" -ne 0 ]; then
    if ! command -v sudo >/dev/null; then
        echo "setup: not root and no sudo. As root, run: apt-get install ${packages[*]}" >&2
        exit 1
    fi
    sudo="sudo"
fi

# A fresh machine has no package lists, or old ones that name files the mirror no longer has.
install() {
    $sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "${packages[@]}"
}
if ! apt-get install -s --no-install-recommends "${packages[@]}" >/dev/null 2>&1 || ! install; then
    $sudo apt-get update
    install
fi

lacking=$(missing)
if [ -n "$lacking" ]; then
    echo "setup: still missing after apt-get install ${packages[*]}: $lacking" >&2
    exit 1
fi
