// ================================================================================================
// rosbayes: bm1_simulated, for Verilator
// Simulated board: executes requests from standard input on the AXI4-Lite slave of bm1.
// MIT licence; datasheet: docs/hardware/simulation.md
// ================================================================================================

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "Vbm1.h"
#include "verilated.h"

namespace {

constexpr uint32_t LONGEST_ACCESS = 1000000;  // clocks, after which an access without an answer ends the simulation

Vbm1 board;
uint32_t clocks;

// Let the signals settle before the clock's edge.
void settle() {
    board.clk_i = 0;
    board.eval();
}

void edge() {
    board.clk_i = 1;
    board.eval();
    ++clocks;
}

// Read or write a word, and return the response; reads store the word.
unsigned access_word(bool write, uint32_t address, uint32_t *data) {
    board.axi_awaddr = board.axi_araddr = address;
    board.axi_wdata = *data;
    board.axi_awvalid = board.axi_wvalid = write;
    board.axi_arvalid = !write;
    for (const uint32_t began = clocks; clocks - began < LONGEST_ACCESS;) {
        settle();
        const bool accepted = write ? board.axi_awready : board.axi_arready;
        const bool answered = write ? board.axi_bvalid : board.axi_rvalid;
        const unsigned response = write ? board.axi_bresp : board.axi_rresp;
        if (!write) *data = board.axi_rdata;
        edge();
        if (accepted) board.axi_awvalid = board.axi_wvalid = board.axi_arvalid = 0;
        if (answered) return response;
    }
    fprintf(stderr, "the hardware does not answer an access\n");
    exit(1);
}

}  // namespace

// The clock stands still between requests, and the simulation ends with the end of standard input.
int main() {
    board.axi_wstrb = 15;
    board.axi_bready = board.axi_rready = 1;
    char request[64];
    while (fgets(request, sizeof request, stdin)) {
        char operation;
        uint32_t first, second;
        if (sscanf(request, "%c %x %x", &operation, &first, &second) != 3) return 1;
        unsigned response = 0;
        std::string words;
        clocks = 0;
        if (operation == 'r') {
            for (uint32_t at = 0; at < second && response == 0; ++at) {
                uint32_t data = 0;
                char text[9];
                response = access_word(false, first + 4 * at, &data);
                snprintf(text, sizeof text, "%08X", data);
                if (response == 0) words += text;
            }
        } else if (operation == 'w') {
            response = access_word(true, first, &second);
        } else if (operation == 'c') {
            while (clocks < first && response == 0) {
                settle();
                response = board.irq_o;
                edge();
            }
        } else {
            board.rstn_i = 0;
            for (int cycle = 0; cycle < 2; ++cycle) {
                settle();
                edge();
            }
            board.rstn_i = 1;
        }
        printf("%X %08X %s\n", response, clocks, words.c_str());
        fflush(stdout);
    }
    return 0;
}
