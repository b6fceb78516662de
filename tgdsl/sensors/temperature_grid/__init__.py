"""Temperature grid: heat in links that are divided into cells, and in what they touch."""
