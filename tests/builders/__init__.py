"""What tests build their cases from: records, fitted turbines, pages, servers.  Tests import it, never each
other."""
