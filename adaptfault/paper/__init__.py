"""The paper's experiments, repeated and taken further: settings, bench, ledger, figures, claims, page."""
