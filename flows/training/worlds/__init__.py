"""Textured worlds to train on: the tracks of SuperTuxKart, as Debian packages them, photographed by ray casting.

`package` finds and fetches the data and knows its licences, `spm` and `scene` read it, `textures` and `world` turn a
track into something that rays can hit and colour, `cameras` places captures in it, `groups` photographs one, and
`shards` writes them. Nothing of the data is part of this project.
"""
