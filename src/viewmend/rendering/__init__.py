"""Frame and target camera to IncompleteView: view selection, blending, error map."""
