"""What can be wrong with a plain recording: one module for each family of effects finds and fits them, in
folders by what they look at; `courses` is what several compare levels with."""
