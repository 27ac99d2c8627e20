"""Documents of what an auditor asks for: certificates, models that a field is compared with."""
