#!/bin/sh
# Makes the virtual environment with everything `make demo` and `make test` need. Called by the Makefile.
set -eu
PYTHON=${PYTHON:-python3}
VENV=${VENV:-.venv}

"$PYTHON" -c 'import sys; sys.exit(sys.version_info[:2] < (3, 11))' || {
    echo "cat3d needs Python 3.11 or newer; '$PYTHON' is $("$PYTHON" --version). Set PYTHON=python3.11." >&2; exit 1; }

# Open3D links libusb, which bare systems lack.
if ! ldconfig -p 2>/dev/null | grep -q libusb-1.0; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        { apt-get update -qq && apt-get install -y -qq libusb-1.0-0; } >/dev/null 2>&1 ||
            echo "Could not install libusb-1.0-0; meshes (Open3D) will not work until it is there." >&2
    else
        echo "For meshes, Open3D needs libusb: type  sudo apt-get install -y libusb-1.0-0" >&2
    fi
fi

[ -x "$VENV/bin/python" ] || "$PYTHON" -m venv "$VENV"
# torch first and pinned exactly, so that a CPU wheel on disk is taken where there is one.
"$VENV/bin/python" -m pip install -q -c constraints.txt torch
"$VENV/bin/python" -m pip install -q -c constraints.txt -e '.[test,lint,docs]'
# Weights only: its code would need torchvision, so its dependencies are left out.
"$VENV/bin/python" -m pip install -q -c constraints.txt --no-deps stlpips-pytorch ||
    echo "stlpips-pytorch could not be installed; the perceptual metric needs weights of your own then." >&2
