"""Signal pipelines: from recorded signals to the rows W beta = b of a fit, one per file."""
