"""What the model knows of a photograph beside its relit pictures: shading, reflectance, normals, its own light, and how
sure all of them are.

``face`` asks the model about the aligned crop, ``lambert`` takes from its n what shadows did to it, ``own_light`` is
the photograph's light with its colours, ``highlights`` parts what skin mirrors, ``decomposition`` puts the maps on the
photograph, ``pictures`` and ``command`` write them.
"""
