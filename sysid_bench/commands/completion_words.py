"""Words that a shell completes, from the registries; kept in the user's cache."""

from sysid_bench import plugin_names
from sysid_bench.commands.catalogue import KINDS, WORDS
from sysid_bench.commands.report import FORMATS
from sysid_bench.metrics import METRICS
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.reference.pages import title_by_page
from sysid_bench.words import CELL_FIELDS, FINDINGS


def words_by_kind() -> dict[str, list[str]]:
    """Return the words that only an installation changes, by kind."""
    plugins = {
        f"{kind.replace('_', '-')}s": sorted(plugin_names.known(kind))
        for kind in plugin_names.BUILTIN
    }
    words = {
        **plugins,
        **{kind: list(words) for kind, words in WORDS.items()},
        "terms": [*WORDS["terms"], *plugins["terms"]],
        "metrics": sorted({*METRICS, *plugins["metrics"]}),
        "payloads": list(PAYLOADS),
        "executors": ["local", "dask://", "slurm:"],
        "findings": list(FINDINGS),
        "priors": ["model", "none"],
        "formats": list(FORMATS),
        "fields": sorted(CELL_FIELDS),
        "kinds": list(KINDS),
        "topics": list(title_by_page()),
        "shells": ["bash", "zsh", "fish"],
        "truths": ["wls", "lmi"],
    }
    named = (*plugins, *WORDS, "payloads")
    return words | {"names": sorted({name for kind in named for name in words[kind]})}
