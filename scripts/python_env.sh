# Sourced by what uses the Python module: virtual environments in target/python, and the module's wheel.
# PYTHON is the interpreter, FEATURES=opencv builds the module with OpenCV.
python=${PYTHON:-python3}
mkdir -p "${CARGO_TARGET_DIR:-target}"
target=$(cd "${CARGO_TARGET_DIR:-target}" && pwd)
work=$target/python

environment() { # name, packages
    [ -x "$work/$1/bin/python" ] || "$python" -m venv "$work/$1"
    "$work/$1/bin/python" -m pip install --quiet --disable-pip-version-check "${@:2}"
}

build_wheel() { # name of the environment that has maturin
    rm -rf "$work/wheels"
    CARGO_TARGET_DIR=$target "$work/$1/bin/maturin" build --quiet --release --locked --auditwheel skip --features "${FEATURES:-}" \
        --manifest-path python/Cargo.toml --out "$work/wheels"
}

install_wheel() { # name
    local wheel=("$work"/wheels/acquire-*.whl)
    "$work/$1/bin/python" -m pip install --quiet --disable-pip-version-check --force-reinstall --no-deps "${wheel[0]}"
}
