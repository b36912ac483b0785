"""Tables, figures and statistics made from the folders of runs."""
