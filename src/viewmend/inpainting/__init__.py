"""IncompleteView, context and state to CompletedView: the method of sections 2 to 7 and 9."""
