% Prints every estimate of a daemon on this machine, through MATLAB's own Python interface:
% pyenv(Version="/opt/shearloop/bin/python"), or any Python with pyzmq and msgpack.
socket = py.zmq.Context().socket(py.zmq.SUB);
socket.connect("tcp://127.0.0.1:7761");
socket.subscribe("eit.estimate");
while true
    frames = cell(socket.recv_multipart());
    message = struct(py.msgpack.unpackb(frames{2}));
    if message.valid
        fprintf("%.3f  %s  %+.4f N·m\n", message.timestamp, string(message.source), message.torque_nm);
    else
        fprintf("%.3f  %s  no estimate: %s\n", message.timestamp, string(message.source), string(message.reason));
    end
end
