"""The documentation as a site: navigation, pages made of docstrings and registries, equations as MathML."""
