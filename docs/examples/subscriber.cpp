// Prints every estimate of a daemon on this machine:
// g++ subscriber.cpp -lzmq -o subscriber   (Debian: libzmq3-dev, nlohmann-json3-dev)
#include <iostream>
#include <nlohmann/json.hpp>
#include <zmq.h>

int main() {
    void *socket = zmq_socket(zmq_ctx_new(), ZMQ_SUB);
    zmq_connect(socket, "tcp://127.0.0.1:7761");
    zmq_setsockopt(socket, ZMQ_SUBSCRIBE, "eit.estimate", 12);
    static char topic[64], payload[1 << 20];
    while (zmq_recv(socket, topic, sizeof topic, 0) >= 0) {
        const int size = zmq_recv(socket, payload, sizeof payload, 0);
        const auto message = nlohmann::json::from_msgpack(payload, payload + size);
        std::cout << message["timestamp"] << ' ' << message["source"].get<std::string>() << ' ';
        if (message["valid"]) std::cout << message["torque_nm"] << " N·m" << std::endl;
        else std::cout << "no estimate: " << message["reason"].get<std::string>() << std::endl;
    }
}
