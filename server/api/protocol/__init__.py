"""Protocol of requests and answers: keys, guards, entity tags, pages, problems."""
