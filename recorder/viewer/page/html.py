"""The page as one HTML text without references to other files."""

from __future__ import annotations

import base64
import hashlib
from importlib.resources import files
from string import Template

_SCRIPTS = ("data.js", "scene.js", "plots.js", "images.js", "main.js")


def page_html(log: bytes, episode: bytes = b"") -> str:
    """Return the page.

    Texts from the log are encoded as base64, and the page's Content Security Policy permits only
    the scripts of this package. Therefore, no text can become HTML or code.

    Args:
        log: Packed description of the log.
        episode: Packed data of the only episode; empty if the page requests episodes from its
            server.
    """
    style = _text("vendor/libraries.min.css") + _text("assets/style.css")
    names = ("vendor/libraries.min.js", *(f"assets/{name}" for name in _SCRIPTS))
    scripts = [_text(name) for name in names]
    policy = [
        "default-src 'none'",
        f"script-src {' '.join(map(_hash, scripts))}",
        # uPlot and OrbitControls set styles from scripts. `style-src` does not prevent this.
        f"style-src {_hash(style)}",
        "img-src data:",
        "base-uri 'none'; form-action 'none'",
        "connect-src 'none'" if episode else "connect-src 'self'",
    ]
    return Template(_text("assets/index.html")).substitute(
        policy="; ".join(policy),
        licenses=_text("vendor/LICENSES.txt"),
        style=style,
        log=base64.b64encode(log).decode(),
        episode=base64.b64encode(episode).decode(),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
    )


def _text(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
