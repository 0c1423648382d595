"""The page of `stereophd.commands.report`: one HTML file with its data, script and style inside."""
