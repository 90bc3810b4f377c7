// A message of tracks/<id> in C++17, with nothing but the standard library: who is where, in metres (docs/wire.md).
//
//     c++ -std=c++17 -O2 -o read_tracks read_tracks.cpp
//     read_tracks < message.bin
//
// With Zenoh's C++ library the bytes come from a subscriber of swarmtrack/TEAM/v1/tracks/*.

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <vector>

// --- MessagePack: as much of it as our messages have -------------------------------------------------------------

struct Value {
    enum Kind { Nil, Bool, Number, Text, Bytes, Array, Map } kind = Nil;
    double number = 0.0;       // of integers, too: ours are below 2^53
    std::string text;          // of Text and Bytes
    std::vector<Value> items;  // of an Array; of a Map keys and values in turn

    const Value& operator[](std::size_t i) const {
        if (kind != Array || i >= items.size()) throw std::runtime_error("a field is missing");
        return items[i];
    }
    double as_number() const {
        if (kind != Number || !std::isfinite(number)) throw std::runtime_error("expected a finite number");
        return number;
    }
};

class Reader {
public:
    Reader(const std::uint8_t* data, std::size_t size) : at_(data), end_(data + size) {}

    Value read(int depth = 0) {
        if (depth > 16) throw std::runtime_error("nested too deeply");
        const unsigned head = take(1);
        Value value;
        if (head < 0x80 || head >= 0xe0) return number(head < 0x80 ? head : static_cast<int>(head) - 256);
        if (head < 0x90) return container(Value::Map, head & 0x0f, depth);
        if (head < 0xa0) return container(Value::Array, head & 0x0f, depth);
        if (head < 0xc0) return text(Value::Text, head & 0x1f);
        switch (head) {
            case 0xc0: return value;
            case 0xc2: case 0xc3: value.kind = Value::Bool; value.number = head & 1; return value;
            case 0xc4: case 0xc5: case 0xc6: return text(Value::Bytes, take(1u << (head - 0xc4)));
            case 0xca: { const auto bits = static_cast<std::uint32_t>(take(4)); float f; std::memcpy(&f, &bits, 4); return number(f); }
            case 0xcb: { const std::uint64_t bits = take(8); double d; std::memcpy(&d, &bits, 8); return number(d); }
            case 0xcc: case 0xcd: case 0xce: case 0xcf: return number(static_cast<double>(take(1u << (head - 0xcc))));
            case 0xd0: return number(static_cast<std::int8_t>(take(1)));
            case 0xd1: return number(static_cast<std::int16_t>(take(2)));
            case 0xd2: return number(static_cast<std::int32_t>(take(4)));
            case 0xd3: return number(static_cast<double>(static_cast<std::int64_t>(take(8))));
            case 0xd9: case 0xda: case 0xdb: return text(Value::Text, take(1u << (head - 0xd9)));
            case 0xdc: case 0xdd: return container(Value::Array, take(2u << (head - 0xdc)), depth);
            case 0xde: case 0xdf: return container(Value::Map, take(2u << (head - 0xde)), depth);
        }
        throw std::runtime_error("a type that our messages do not have");
    }

private:
    std::uint64_t take(std::size_t bytes) {  // big-endian
        if (static_cast<std::size_t>(end_ - at_) < bytes) throw std::runtime_error("cut off");
        std::uint64_t value = 0;
        for (std::size_t i = 0; i < bytes; ++i) value = value << 8 | *at_++;
        return value;
    }
    static Value number(double d) { Value value; value.kind = Value::Number; value.number = d; return value; }
    Value text(Value::Kind kind, std::uint64_t size) {
        if (size > static_cast<std::uint64_t>(end_ - at_)) throw std::runtime_error("cut off");
        Value value;
        value.kind = kind;
        value.text.assign(at_, at_ + size);
        at_ += size;
        return value;
    }
    Value container(Value::Kind kind, std::uint64_t size, int depth) {
        if (kind == Value::Map) size *= 2;
        // Each item takes a byte or more: a claimed size costs nothing.
        if (size > static_cast<std::uint64_t>(end_ - at_)) throw std::runtime_error("cut off");
        Value value;
        value.kind = kind;
        for (std::uint64_t i = 0; i < size; ++i) value.items.push_back(read(depth + 1));
        return value;
    }
    const std::uint8_t* at_;
    const std::uint8_t* end_;
};

// --- tracks/<id> ---------------------------------------------------------------------------------------------------

struct Place {
    double position[3], velocity[3];  // m, m/s: teammate minus camera, north, east, down
    double sigma;                     // m, of the distance

    double distance() const { return std::hypot(position[0], position[1], position[2]); }
};

// An entry of an upper triangle: a number of an array, or a big-endian integer of 16 bits.
double entry_of(const Value& upper, std::size_t k) {
    if (upper.kind != Value::Bytes) return upper[k].as_number();
    if (upper.text.size() < 2 * k + 2) throw std::runtime_error("a covariance is cut off");
    const auto high = static_cast<std::uint8_t>(upper.text[2 * k]), low = static_cast<std::uint8_t>(upper.text[2 * k + 1]);
    return static_cast<std::int16_t>(high << 8 | low);
}

Place place_of(const Value& relative) {
    Place place{};
    for (int i = 0; i < 3; ++i) {
        place.position[i] = relative[1][i].as_number();
        place.velocity[i] = relative[2][i].as_number();
    }
    double variance = 0.0, cov[6][6];
    // The covariance of (position, velocity), (6, 6), comes as its upper triangle, row by row.
    for (int row = 0, k = 0; row < 6; ++row)
        for (int column = row; column < 6; ++column, ++k) cov[row][column] = entry_of(relative[3], k);
    if (relative[3].kind == Value::Bytes) {  // the short form: logarithms of standard deviations, and correlations
        double sigma[6];
        for (int i = 0; i < 6; ++i) sigma[i] = cov[i][i] == -32768.0 ? 0.0 : std::exp(cov[i][i] / 1024.0);
        for (int row = 0; row < 6; ++row)
            for (int column = row; column < 6; ++column)
                cov[row][column] = sigma[row] * sigma[column] * (row == column ? 1.0 : cov[row][column] / 32767.0);
    }
    for (int row = 0; row < 6; ++row)
        for (int column = 0; column < row; ++column) cov[row][column] = cov[column][row];
    const double distance = place.distance();
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) variance += place.position[i] * cov[i][j] * place.position[j] / (distance * distance);
    place.sigma = std::sqrt(variance);
    return place;
}

void print_tracks(const Value& message) {
    if (message[0].as_number() != 1.0) throw std::runtime_error("another version");
    std::printf("t_utc_s %.3f\n", message[1].as_number());
    for (const Value& track : message[5].items) {
        const Value& identity = track[1];
        const std::string name = identity.kind == Value::Number ? "drone " + std::to_string(static_cast<int>(identity.number))
                                 : identity.kind == Value::Text ? identity.text
                                                                : "unknown";
        std::printf("track %.0f: %s (%.2f) at (%.1f, %.1f) px\n", track[0].as_number(), name.c_str(),
                    track[2].as_number(), track[3].as_number(), track[5].as_number());
    }
    // Fields at the end are there only where they say something, and newer messages may have more of them.
    if (message.items.size() <= 7) return;
    for (const Value& relative : message[7].items) {
        const Place p = place_of(relative);
        std::printf("track %.0f: north %.2f east %.2f down %.2f m, %.2f m ± %.2f\n", relative[0].as_number(), p.position[0],
                    p.position[1], p.position[2], p.distance(), p.sigma);
    }
}

int main() {
    const std::string bytes{std::istreambuf_iterator<char>(std::cin), {}};
    try {
        if (bytes.size() > 65536) throw std::runtime_error("more than 64 KiB");
        print_tracks(Reader(reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size()).read());
    } catch (const std::exception& error) {
        std::fprintf(stderr, "no message of tracks: %s\n", error.what());
        return 1;
    }
}
