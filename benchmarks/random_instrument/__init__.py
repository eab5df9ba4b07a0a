"""The random instrument: everything a little wrong at once, told nominal; how far results and errors hold."""
