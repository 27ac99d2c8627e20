"""How requests are let in and answered: keys, guards, entity tags, pages, problems."""
