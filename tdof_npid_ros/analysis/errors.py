"""The one error of the package."""


class AnalysisError(ValueError):
    """A bag in which there is nothing to analyse. The message is one line: what, where, what to do."""
