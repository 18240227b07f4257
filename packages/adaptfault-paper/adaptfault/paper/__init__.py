"""The paper's experiments and extensions: settings, bench, ledger, figures, claims, page."""
