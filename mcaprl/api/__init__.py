"""The functions of the public API, one module per command; `mcaprl` exports them."""

import mcaprl.sims  # noqa: F401  (registers the environments)
from mcaprl.lazy import lazy_attributes

__all__ = ["SCRIPTED", "load_policies"]

__getattr__ = lazy_attributes(__name__, {"mcaprl.api.policies": __all__})
