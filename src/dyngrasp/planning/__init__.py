"""From a part's pose to an audited plan of arm and hand."""
