"""The artificial finger skin: geometry and material, its finite elements, its condensed form.

``settings`` documents the skin, ``mesh`` and ``elasticity`` make its finite elements, ``condensed``
keeps what contact needs of them (compliance of the contact nodes, stress rows of the strips).
Nothing here knows of friction, time or instruments. Importing this package costs nothing.
"""
