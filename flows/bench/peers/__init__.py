"""Other people's programs on the same scenes, beside ours, in one run: `cat3d bench peers`.

`compare` hands the same task to a process of ours and to one of each peer's, which runs in an environment of its own
(`make peers`), and collects what both measured. Nothing of a peer is a dependency of ours.
"""
