"""The artificial finger skin: geometry and material, finite elements, condensed form.

``settings`` describes the skin, ``mesh`` and ``elasticity`` compute its finite elements, and
``condensed`` stores what contact needs of them (compliance of the contact nodes, stress rows of the
strips). Friction, time and instruments are not part of this package. Importing it is fast, because
the finite elements are imported on first use.
"""
