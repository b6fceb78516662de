"""A Sphinx extension that generates reference pages from the package: see `extension`."""
