import socket

from nics_drl_bridge.nodes.transport import domains_in_use, multicast_port, ports_of


def test_a_domain_is_in_use_while_a_port_of_it_is_bound():
    for domain_id in set(range(1, 101)) - domains_in_use():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
            port = multicast_port(domain_id) + 10
            end.bind(("127.0.0.1", port))
            assert domain_id in domains_in_use()
            assert port in ports_of()
        assert domain_id not in domains_in_use()
        assert port not in ports_of()
        return
    raise AssertionError("no domain is unused")
