"""Datasets to and from other formats: `deformable_ravens` in, `lerobot` and `robomimic` out.

A conversion is built beside its destination and renamed when it is whole. The one place where
pickles are read is `restricted_pickle`: its process knows no class and no function of anybody's.
"""
