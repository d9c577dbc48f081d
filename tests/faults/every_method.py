"""The built-in estimators as somebody else's: the same code, found in a file."""

from sysid_bench.plugin_names import BUILTIN, resolve

for _name in BUILTIN["estimator"]:
    globals()[_name.replace("-", "_")] = resolve("estimator", _name)
