"""Results on object storage (`--out s3://BUCKET/FOLDER`): a working copy on a file system, and what keeps both alike.

Stores are written by renames and guarded by locks, which object storage does not have. So commands work on a copy on a
file system, and what they finish is copied to the bucket: data before the records that speak of them, under a claim
that conditional writes guard. `address.py` says where the copy is, `claim.py` who may write, `mirror.py` copies.
"""

from __future__ import annotations

from flows.object_storage.address import address_of
from flows.object_storage.open import copy_out, results_at

__all__ = ["address_of", "copy_out", "results_at"]
