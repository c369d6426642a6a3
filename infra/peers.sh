#!/bin/sh
# Makes the environment of the programs that `cat3d bench peers` compares with. Called by `make peers`.
set -eu
PYTHON=${PYTHON:-python3}
PEERS=${CAT3D_PEERS:-.venv-peers}

[ -x "$PEERS/bin/python" ] || "$PYTHON" -m venv "$PEERS"
"$PEERS/bin/python" -m pip install -q --no-deps -r infra/peers.txt
"$PEERS/bin/python" -m pip install -q -r infra/peers_support.txt
echo "Compare with: .venv/bin/cat3d bench peers"
