"""An asset as a web page: one HTML file that plays it, or a folder for a web server.

>>> from player import Asset
>>> from player.page import page
>>> html = page(Asset.open("out/"))
"""

from player.page.notebook import inline
from player.page.page import page

__all__ = ["inline", "page"]
