# Sourced by the scripts of peers, which name their folder $here: a folder $work that goes when they end, and $venv, an
# installation of the pinned peers; VENV keeps it.
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
venv=${VENV:-$work/venv}
if [ ! -x "$venv/bin/python" ]; then
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --requirement "$here/requirements.txt"
fi
