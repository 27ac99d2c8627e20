"""Nothing yet."""
def write_page():
    return None
